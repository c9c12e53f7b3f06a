"""psf at its ends: dynamic range, exposure, few captures, wide kernels, the pupil near and far, wrong starts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tests.benchmarks.extremes.case import Case, Outcome, outcome
from tests.scenes.psf import Scene, pictures, shots_of, small_scene
from udccal.fitting.psf.data import PsfData, PsfRules
from udccal.fitting.psf.fit import fit_psf
from udccal.fitting.psf.kernel import BLUR, start_model, start_prior
from udccal.models.psf import PsfField
from udccal.result import FitResult

_RULES = PsfRules(positions=8, shifts=3, half_px=(14, 7), close_px=(14, 7), far_fraction=1.0, iterations=60)
_SCENE = small_scene(positions=(3, 2), shifts=2, half=(14, 7))
_NUMBERS = ("column_open", "row_open", "depth_mm", "pupil_diameter_mm")


@dataclass(frozen=True)
class Off:
    """Factors by which the rig description that the fit starts from is off; the truth stays."""

    pitch: float = 1.0
    standoff: float = 1.0
    pupil: float = 1.0


def _fit(scene: Scene, off: Off = Off(), seed: int = 1) -> Outcome:
    """Pictures of a rig as it was built to be, fitted from a description that may be wrong."""
    true = start_prior(scene.rig, start_model(scene.rig, scene.geometry, scene.wire)).mean
    rng = np.random.default_rng(seed)
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
    return outcome(result, _errors(result, true))


def fit_from(off: Off) -> Outcome:
    """The same rig from a wrong description."""
    return _fit(_SCENE, off)


def _errors(result: FitResult[PsfField], true: np.ndarray) -> np.ndarray:
    if not result.ok or not float(result.term.diffraction_fraction):
        return np.zeros(0)
    estimates = [result.estimate(name) for name in _NUMBERS]
    return np.array([(e.value - t) / e.sigma for e, t in zip(estimates, true[1:BLUR], strict=True)])


def _with(**changes: object) -> Scene:
    return replace(_SCENE, **changes)


def _standoff(distance_mm: float) -> Outcome:
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
        )
    )


def _exposures(count: int, level: float = 0.8) -> Scene:
    return _with(exposures_s=tuple(1e-3 * 4.0**k for k in range(count)), level=level)


_FEW = small_scene(positions=(2, 1), shifts=2, half=(14, 7))

CASES = (
    Case("psf", "a single exposure, dynamic range 10^2", lambda: _fit(_exposures(1))),
    Case("psf", "12 exposures, dynamic range 10^7", lambda: _fit(_exposures(12))),
    Case("psf", "all exposures too short, peak at 8 % of the range", lambda: _fit(_exposures(2, 0.08))),
    Case("psf", "peak clipped in all exposures but by little", lambda: _fit(_exposures(6, 1.3))),
    Case("psf", "one picture per position", lambda: _fit(_with(shifts=1))),
    Case("psf", "two positions", lambda: _fit(_FEW)),
    Case("psf", "a window far smaller than the kernel", lambda: _fit(_with(half=(7, 5)))),
    Case("psf", "pupil 1 mm behind the panel", lambda: _standoff(1.0)),
    Case("psf", "pupil 100 mm behind the panel", lambda: _standoff(100.0)),
    Case("psf", "start 20 % too wide a pupil", lambda: fit_from(Off(pupil=1.2))),
    Case("psf", "start 20 % too narrow a pupil", lambda: fit_from(Off(pupil=0.8))),
    Case("psf", "start 20 % too large a pitch", lambda: fit_from(Off(pitch=1.2))),
    Case("psf", "start 20 % too small a pitch", lambda: fit_from(Off(pitch=0.8))),
    Case("psf", "start 20 % too large a stand-off", lambda: fit_from(Off(standoff=1.2))),
)
