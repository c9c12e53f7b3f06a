"""The psf's part of planned against obtained: LEDs in small windows of the rig as built, drawn and fitted many times.

The error of the kernel is looked at where the prediction looks at it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from procedures.psf import led_positions_px
from tests.benchmarks.psf_kernels import kernel_and_slopes
from tests.scenes.psf import DISC_PX, Scene, pictures, shots_of, small_scene
from udccal.arrangements import Led
from udccal.effort import FitEffort
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.psf.diffraction import fit_diffraction
from udccal.fitting.psf.kernel import WAVELENGTHS_NM, Evaluator, fit_lattice
from udccal.fitting.psf.start import some_shots, start_model, start_prior
from udccal.numerics import in_float64
from udccal.planning.psf import PsfPredictor
from udccal.planning.state import RigState
from udccal.rig import Captures, RigDescription

_HALF = (14, 7)
# A region leaves so much beside the window.
_SPARE_PX = 4
_PLACES = np.array([[0.45, 0.55], [0.15, 0.2], [0.85, 0.7]])
# (columns, rows, shifts, exposures): the second has to scale from the first.
DESIGNS = ((3, 2, 2, 6), (4, 3, 3, 4))


@final
@dataclass(frozen=True)
class Compared:
    """One design: relative L2 of the kernel in per cent, as forecast, as estimated by the fits, and as found.

    ``spread`` is the relative standard error of what was found in so many ``realisations``.
    """

    name: str
    realisations: int
    predicted: float
    stated: float
    obtained: float
    spread: float


def compared_psf(realisations: int) -> list[Compared]:
    """Every design, fitted so many times."""
    return [compared(design, realisations) for design in DESIGNS]


def compared(design: tuple[int, int, int, int], realisations: int) -> Compared:
    scene, captures = _scene(design)
    state = RigState(scene.rig, scene.noise, scene.geometry, wire=scene.wire)
    predicted = PsfPredictor(state).sigma(captures)
    prior = start_prior(scene.rig, start_model(scene.rig, scene.geometry, scene.wire))
    found = np.array([_realisation(scene, prior, seed) for seed in range(realisations)])
    squared, stated = found.mean(axis=0)
    spread = 0.5 * found[:, 0].std() / np.sqrt(max(realisations - 1, 1)) / squared
    name = f"{design[0]} x {design[1]} positions, {design[2]} shifts, {design[3]} exposures"
    return Compared(
        name, realisations, predicted, 100 * float(np.sqrt(stated)), 100 * float(np.sqrt(squared)), float(spread)
    )


def _scene(design: tuple[int, int, int, int]) -> tuple[Scene, Captures]:
    """Where the procedure would put the LED, and how it would expose it."""
    columns, rows, shifts, exposures = design
    scene = small_scene(half=_HALF)
    rig = scene.rig
    away_mm = rig.captures.psf_distance_mm + rig.mounting.standoff_mm.value
    captures = rig.captures.model_copy(
        update={
            "psf_columns": columns,
            "psf_rows": rows,
            "psf_shifts": shifts,
            "psf_exposures": exposures,
            "psf_region_rows": 2 * (_HALF[0] + _SPARE_PX),
            "psf_region_columns": 2 * (_HALF[1] + _SPARE_PX),
            "psf_led_mm": DISC_PX * away_mm / rig.focal_px,
        }
    )
    planned = rig.model_copy(update={"captures": captures})
    step = next(s for s in RigState(planned, scene.noise, scene.geometry).steps("psf") if _is_led(s))
    return replace(
        scene,
        rig=planned,
        places_px=_inside(planned),
        shifts=shifts,
        exposures_s=step.exposures_s,
        level=step.level,
    ), captures


def _is_led(step: object) -> bool:
    return isinstance(getattr(step, "arrangement", None), Led)


def _inside(rig: RigDescription) -> Float[np.ndarray, "positions 2"]:
    """The procedure's positions, as far from the border as the window reaches."""
    room = np.array(_HALF[::-1]) + 2 * _SPARE_PX
    size = np.array([rig.camera.columns, rig.camera.rows])
    return np.clip(led_positions_px(rig), room, size - room).astype(np.float64)


@in_float64
def _realisation(scene: Scene, prior: Prior, seed: int) -> tuple[float, float]:
    """Squared relative L2 error of the kernel, mean over places and colours: found, and estimated by the fit."""
    rng, theta = np.random.default_rng([seed, 5]), prior.mean
    shots = shots_of(scene, pictures(scene, theta, rng), rng)
    rules = replace(FitEffort().psf, close_px=_HALF)
    chosen = shots.pick(some_shots(shots, rules))
    start = start_model(scene.rig, scene.geometry, scene.wire)
    fit = fit_diffraction(chosen, scene.geometry, start, prior, rules)
    found, stated = 0.0, 0.0
    places = _PLACES * [scene.rig.camera.columns, scene.rig.camera.rows]
    for place in places:
        true, _ = _kernel(scene, theta, place)
        kernel, slopes = _kernel(scene, fit.theta, place)
        size = (true**2).sum(axis=(1, 2))
        found += float((((kernel - true) ** 2).sum(axis=(1, 2)) / size).mean())
        variance = np.einsum("pcyx,pq,qcyx->cyx", slopes, fit.noise_cov, slopes)
        stated += float((variance.sum(axis=(1, 2)) / size).mean())
    return found / len(places), stated / len(places)


def _kernel(
    scene: Scene, theta: Float[np.ndarray, " p"], place: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "3 rows columns"], Float[np.ndarray, "p 3 rows columns"]]:
    evaluator = Evaluator(WAVELENGTHS_NM, fit_lattice(_HALF), True)
    rows, columns = (2 * half + 1 for half in _HALF)
    value, slopes = kernel_and_slopes(evaluator, theta, scene.geometry, place, rows, columns)
    return np.asarray(value), np.asarray(slopes)
