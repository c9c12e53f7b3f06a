"""psf at its ends: dynamic range, exposure, few captures, wide kernels, the pupil near and far, wrong starts.

Every case draws its truth from the prior of the rig's description. Judged are the numbers of the panel and the pupil,
and what a case is named for: the kernel at a field point, and the pitch where the description of it is wrong. The
stand-off is the wire's number; here, only the kernel can be right or wrong by it.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tests.benchmarks.efficiency.psf import POINTS_PX, SAMPLES, WINDOW
from tests.benchmarks.extremes.case import Case, Outcome, outcome
from tests.scenes.psf import Scene, pictures, shots_of, small_scene
from udccal.fitting.psf.data import PsfData, PsfRules
from udccal.fitting.psf.fit import fit_psf
from udccal.fitting.psf.kernel import WAVELENGTHS_NM, Evaluator, fit_lattice
from udccal.fitting.psf.start import start_model, start_prior
from udccal.models.psf import PsfField, psf_kernels
from udccal.numerics import in_float64
from udccal.result import FitResult

_RULES = PsfRules(positions=8, shifts=3, half_px=(14, 7), close_px=(14, 7), far_fraction=1.0, iterations=60)
_SCENE = small_scene(positions=(3, 2), shifts=2, half=(14, 7))
# In the order of the fit's parameters.
_NUMBERS = ("pitch_mm", "column_open", "row_open", "depth_mm", "pupil_diameter_mm")


@dataclass(frozen=True)
class Off:
    """Factors by which the rig description that the fit starts from is off; the truth stays."""

    pitch: float = 1.0
    standoff: float = 1.0
    pupil: float = 1.0


def _fit(scene: Scene, off: Off = Off(), seed: int = 1) -> Outcome:
    """Pictures of a rig drawn from the prior, fitted from a description that may be wrong."""
    prior, rng = start_prior(scene.rig, start_model(scene.rig, scene.geometry, scene.wire)), np.random.default_rng(seed)
    cov = np.linalg.inv(prior.precision)
    true = prior.mean + np.linalg.cholesky(cov) @ rng.standard_normal(len(cov))
    shots = shots_of(scene, pictures(scene, true, rng), rng)
    wire, rig = scene.wire, scene.rig
    wire = replace(
        wire,
        footprint_per_pitch=wire.footprint_per_pitch * off.pupil,
        standoff_per_pitch=wire.standoff_per_pitch * off.standoff,
    )
    pitch = rig.panel.pitch_mm
    # A description that is far off, and says that it may be.
    tolerance = max(pitch.tolerance, 1.25 * abs(off.pitch - 1) * pitch.value)
    wrong = pitch.model_copy(update={"value": pitch.value * off.pitch, "tolerance": tolerance})
    rig = rig.model_copy(update={"panel": rig.panel.model_copy(update={"pitch_mm": wrong})})
    result = fit_psf(PsfData(shots), rig, scene.geometry, wire, _RULES)
    return outcome(result, _errors(result, scene, true) if result.ok else None)


def fit_from(off: Off, seed: int = 1) -> Outcome:
    """A rig from a wrong description."""
    return _fit(_SCENE, off, seed)


@in_float64
def _errors(result: FitResult[PsfField], scene: Scene, true: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
    """Of the numbers, where the fit gives them, and of the kernel at a field point, by the term's own evaluation."""
    found = {estimate.name: estimate for estimate in result.estimates}
    numbers = [
        (found[name].value - value) / found[name].sigma
        for name, value in zip(_NUMBERS, true, strict=False)
        if name in found
    ]

    def fitted(term: PsfField) -> Float[np.ndarray, " samples"]:
        """Samples of the green kernel relative to its peak."""
        (peak_row, peak_column), *others = SAMPLES
        green = np.asarray(psf_kernels(term, POINTS_PX[:1], *WINDOW))[0, 1]
        return np.array([green[row, column] / green[peak_row, peak_column] for row, column in others])

    model = Evaluator(WAVELENGTHS_NM, fit_lattice(scene.half), True).model(true)
    plain = {"diffraction_fraction": np.float64(1.0), "residual": np.zeros_like(result.term.residual)}
    kernel = fitted(result.term) - fitted(replace(result.term, diffraction=model, **plain))
    return np.concatenate([numbers, kernel / result.sigma_of(fitted)])


def _with(**changes: object) -> Scene:
    return replace(_SCENE, **changes)


def _standoff(distance_mm: float, seed: int) -> Outcome:
    """The pupil at another distance behind the panel."""
    mounting = _SCENE.rig.mounting
    moved = mounting.model_copy(update={"standoff_mm": mounting.standoff_mm.model_copy(update={"value": distance_mm})})
    pitch = _SCENE.rig.panel.pitch_mm.value
    pupil = np.array([*np.asarray(_SCENE.geometry.pupil_mm)[:2], -distance_mm])
    return _fit(
        replace(
            _SCENE,
            rig=_SCENE.rig.model_copy(update={"mounting": moved}),
            geometry=replace(_SCENE.geometry, pupil_mm=pupil),
            wire=replace(_SCENE.wire, standoff_per_pitch=np.float64(distance_mm / pitch)),
        ),
        seed=seed,
    )


def _exposures(count: int, level: float = 0.8) -> Scene:
    return _with(exposures_s=tuple(1e-3 * 4.0**k for k in range(count)), level=level)


_FEW = small_scene(positions=(2, 1), shifts=2, half=(14, 7))


def _case(name: str, run: Callable[..., Outcome], *args: object) -> Case:
    """A case whose truth is its own."""
    return Case("psf", name, functools.partial(run, *args, seed=zlib.crc32(name.encode())))


CASES = (
    _case("a single exposure, dynamic range 10^2", _fit, _exposures(1)),
    _case("12 exposures, dynamic range 10^7", _fit, _exposures(12)),
    _case("all exposures too short, peak at 8 % of the range", _fit, _exposures(2, 0.08)),
    _case("peak clipped in all exposures but by little", _fit, _exposures(6, 1.3)),
    _case("one picture per position", _fit, _with(shifts=1)),
    _case("two positions", _fit, _FEW),
    _case("a window far smaller than the kernel", _fit, _with(half=(7, 5))),
    _case("pupil 1 mm behind the panel", _standoff, 1.0),
    _case("pupil 100 mm behind the panel", _standoff, 100.0),
    _case("start 20 % too wide a pupil", fit_from, Off(pupil=1.2)),
    _case("start 20 % too narrow a pupil", fit_from, Off(pupil=0.8)),
    _case("start 20 % too large a pitch", fit_from, Off(pitch=1.2)),
    _case("start 20 % too small a pitch", fit_from, Off(pitch=0.8)),
    _case("start 20 % too large a stand-off", fit_from, Off(standoff=1.2)),
)
