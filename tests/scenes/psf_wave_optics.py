"""LED shots of rigs that no model describes, by wave optics."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
from jaxtyping import Float

from tests.scenes.psf import DISC_PX, FLUX, Picture, Scene, noise_of, shots_of
from udccal.cfa import cfa_named
from udccal.fitting.psf.data import PsfData, PsfRules
from udccal.fitting.psf.fit import fit_psf
from udccal.fitting.wire.parameters import ideal_wire, wire_start
from udccal.models.geometry import Geometry
from udccal.models.psf import PsfField, psf_kernels
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.reports.true_values import true_geometry
from udccal.result import FitResult
from udccal.rig import load_rig
from udccal.simulation.psf import captured_light, kernels, spread_at
from udccal.simulation.truth import RigTruth, draw_truth

COVERED: Final = 0.90

_PLACES = 8


def held_out_positions(truth: RigTruth) -> Float[np.ndarray, "n 2"]:
    """Places spread over the sensor that no capture used: random fractions of a pixel included."""
    camera = truth.description.camera
    index = np.arange(1, _PLACES + 1)[:, None]
    spread = np.mod(0.5 + index * np.array([0.7548776662, 0.5698402910]), 1.0)
    return (0.04 + 0.92 * spread) * np.array([camera.columns - 1.0, camera.rows - 1.0])


_HALF, _SPARE, _BORDER_PX = (16, 8), 4, 40


_RULES: Final = PsfRules(positions=9, shifts=2, half_px=_HALF, close_px=_HALF, iterations=40)


@final
@dataclass(frozen=True)
class Coverage:
    """Errors of the kernel at places without an LED.

    Attributes:
        z: z-scores of its samples.
        stated, found: relative L2 error, root mean square over places and colours.
        error_l2: the fit's error at held-out positions; pattern_p: p-value of its residuals' pattern.
    """

    stated: float
    found: float
    error_l2: float
    pattern_p: float
    z: Float[np.ndarray, " n"]

    @property
    def covered(self) -> float:
        """Part of the samples within 1.96 sigma of the truth."""
        return float((np.abs(self.z) <= 1.96).mean())


def coverage(seed: int, columns: int = 4, rows: int = 3, shifts: int = 3) -> Coverage:
    """Of one rig, fitted from LEDs at ``columns`` x ``rows`` positions."""
    truth = draw_truth(load_rig("lg55-reduced"), seed)
    result = fit_truth(truth, columns, rows, shifts, np.random.default_rng([seed, 7]))
    places = held_out_positions(truth)
    window = (2 * _HALF[0] + 1, 2 * _HALF[1] + 1)
    true = kernels(truth, places, *window)

    def kernels_of(term: PsfField) -> Float[np.ndarray, "n 3 rows columns"]:
        return np.asarray(psf_kernels(term, places, *window))

    found, sigma = in_float64(kernels_of)(result.term), result.sigma_of(kernels_of)
    told = {item.name: item.value for item in result.diagnostics}
    return Coverage(
        stated=_relative_l2(sigma, true),
        found=_relative_l2(found - true, true),
        error_l2=told["kernel_error_l2"],
        pattern_p=told["residual_pattern_p"],
        z=((found - true) / np.maximum(sigma, 1e-30)).ravel(),
    )


def fit_truth(truth: RigTruth, columns: int, rows: int, shifts: int, rng: np.random.Generator) -> FitResult[PsfField]:
    """Brackets of LEDs over the whole field, fitted."""
    geometry, rig = true_geometry(truth), truth.description
    wire = seen_by_the_wire(truth, geometry)
    x, y = (
        np.linspace(_BORDER_PX, size - _BORDER_PX, n)
        for size, n in ((rig.camera.columns, columns), (rig.camera.rows, rows))
    )
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).round()
    exposures_s = tuple(1e-3 * 4.0**k for k in range(6))
    scene = Scene(rig, geometry, wire, noise_of(rig), _HALF, places, shifts, exposures_s)
    shots = shots_of(scene, _pictures(truth, scene, rng), rng)
    return fit_psf(PsfData(shots), rig, geometry, wire, _RULES)


def _pictures(truth: RigTruth, scene: Scene, rng: np.random.Generator) -> list[Picture]:
    rows, columns = (2 * (h + _SPARE) + 1 for h in scene.half)
    noise, made = scene.noise, []
    top_e = scene.level * (scene.rig.saturation_DN - float(noise.black_DN)) / float(noise.K_DN_per_e)
    channel = cfa_named(scene.rig.camera.cfa).channel_map(rows, columns)[None]
    for place in scene.places_px:
        spread = spread_at(truth, place + 1.0, (columns / 2 + 4.0, rows / 2 + 4.0))
        for _ in range(scene.shifts):
            aim = place + rng.uniform(0, 2, 2)
            source = aim + rng.uniform(-1, 1, 2)
            corner = (np.round(aim).astype(int) - [columns // 2, rows // 2]) // 2 * 2
            middle = corner + np.array([columns // 2, rows // 2])
            off = (float(source[0] - middle[0]), float(source[1] - middle[1]))
            light = captured_light(truth, middle.astype(float), rows, columns, off, DISC_PX, spread=spread)
            rate = np.take_along_axis(light * FLUX[:, None, None], channel, axis=0)[0]
            full = top_e / scene.exposures_s[0] / rate.max()
            at, aimed = (int(corner[0]), int(corner[1])), (float(aim[0]), float(aim[1]))
            made.append(Picture(rate * full, at, aimed, source, FLUX * full))
    return made


def seen_by_the_wire(truth: RigTruth, geometry: Geometry) -> Wire:
    """A wire as its own fit would find it, a little off."""
    panel, pitch = truth.panel, truth.panel.pitch_mm
    ideal = in_float64(lambda: ideal_wire(geometry, wire_start(truth.description), np.array([[0.0, 1.0]])))()
    return replace(
        ideal,
        offset_periods=truth.optics.pupil_mm[:2] / pitch + 0.01,
        standoff_per_pitch=np.float64((panel.depth_mm / 2 - truth.optics.pupil_mm[2]) / pitch),
        footprint_per_pitch=np.float64(truth.optics.pupil_diameter_mm / pitch * 1.005),
        row_open=np.float64(panel.row_open + 0.003),
        column_open=np.float64(panel.column_open - 0.002),
        depth_per_pitch=np.float64(panel.depth_mm / pitch),
    )


def _relative_l2(error: Float[np.ndarray, "n 3 rows columns"], true: Float[np.ndarray, "n 3 rows columns"]) -> float:
    return float(np.sqrt(np.mean((error**2).sum(axis=(2, 3)) / (true**2).sum(axis=(2, 3)))))
