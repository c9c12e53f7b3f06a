"""psf fit: from brackets of an LED at field positions to the kernel of a point source anywhere on the sensor.

First the few numbers of diffraction by the panel are fitted to some of the shots; then it is tried on the others how
much an image of smooth coefficients, on top of diffraction or instead of it, improves the prediction at positions that
were left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.psf_blocks import blocks, fit_lattice
from udccal.fitting.psf_diffraction import DiffractionFit, fit_diffraction, fit_locals, pose
from udccal.fitting.psf_evidence import diffraction_alone, failed, fit_result
from udccal.fitting.psf_normal import Evaluator
from udccal.fitting.psf_read import read_shots
from udccal.fitting.psf_residual import Sources, with_light_of_peak
from udccal.fitting.psf_select import select_field
from udccal.fitting.psf_shots import Shots
from udccal.fitting.psf_start import WAVELENGTHS_NM, start_model, start_prior, wire_shows
from udccal.fitting.result import FitResult, FitStatus
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.rig import RigDescription
from udccal.sessions.store import Session

_LEAST_POSITIONS = 3
_LEAST_SHARE = 0.5
# All samples about the peak, and this share of the others, go into the fit of diffraction.
_PEAK_HALF_PX, _ELSEWHERE_SHARE = (12, 6), 1 / 6
MODEL_ERROR = 0.015


@dataclass(frozen=True)
class Effort:
    """What the fit may spend: more is slower and more accurate.

    Attributes:
        positions, shifts: so many field positions, and pictures of each, go into the fit of diffraction.
        half_px: largest window (rows, columns) to either side of the LED; the regions captured may bound it further.
        close_px: the same for the fit of diffraction, whose time grows with it.
        iterations: at most, of the fit of diffraction.
    """

    positions: int = 10
    shifts: int = 3
    half_px: tuple[int, int] = (48, 16)
    close_px: tuple[int, int] = (40, 14)
    iterations: int = 30


def fit_psf(
    session: Session, noise: Noise, geometry: Geometry, wire: Wire, effort: Effort | None = None
) -> FitResult[PsfField]:
    """Fit the psf term to the steps ``psf/...`` of a session.

    Args:
        session: brackets of an LED at field positions, each at some sub-pixel shifts.
        noise: for merging brackets.
        geometry: where pixels look.
        wire: divided out, and a start for the panel's numbers.
        effort: what the fit may spend.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    effort = effort or Effort()
    half = window_half(session, effort.half_px)
    reading = read_shots(session, noise, wire, half)
    start = start_model(session.rig, geometry, wire)
    if reading.clipped > (1 - _LEAST_SHARE) * max(reading.taken, 1):
        note = f"{reading.clipped} of {reading.taken} pictures are clipped."
        return failed(start, geometry, FitStatus.SATURATED, note)
    if reading.dark > (1 - _LEAST_SHARE) * max(reading.taken, 1):
        note = f"{reading.dark} of {reading.taken} pictures show no LED."
        return failed(start, geometry, FitStatus.TOO_DARK, note)
    if reading.shots is None or int(reading.shots.position.max()) + 1 < _LEAST_POSITIONS:
        found = 0 if reading.shots is None else int(reading.shots.position.max()) + 1
        note = f"{found} field positions were captured; {_LEAST_POSITIONS} are needed at least."
        return failed(start, geometry, FitStatus.TOO_FEW_DATA, note)
    result = fit_shots(reading.shots, session.rig, geometry, wire, effort)
    left_out = reading.clipped + reading.dark
    note = f"{left_out} pictures were left out: {reading.dark} without an LED, {reading.clipped} clipped."
    return replace(result, notes=(*result.notes, note)) if left_out else result


def nominal_psf(rig: RigDescription, geometry: Geometry, wire: Wire) -> PsfField:
    """What the fit starts from: diffraction by the panel as the rig's description and the wire have it."""
    return diffraction_alone(start_model(rig, geometry, wire), geometry)


def window_half(session: Session, largest: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns) to either side of the LED that the regions captured can fill."""
    regions = [c.region for step in session.steps("psf") for c in step.captures]
    rows, columns = (min((getattr(r, name) for r in regions), default=0) for name in ("rows", "columns"))
    return max(4, min(largest[0], rows // 2 - 4)), max(4, min(largest[1], columns // 2 - 4))


@in_float64
def fit_shots(
    shots: Shots, rig: RigDescription, geometry: Geometry, wire: Wire, effort: Effort | None = None
) -> FitResult[PsfField]:
    """Fit the psf term to crops about the LED; see ``fit_psf``."""
    effort = effort or Effort()
    start = start_model(rig, geometry, wire)
    held_out = held_out_positions(int(shots.position.max()) + 1)
    chosen = shots.pick(some_shots(shots, held_out, effort))
    chosen = replace(chosen, position=np.unique(chosen.position, return_inverse=True)[1].reshape(-1))
    half = (shots.rate.shape[1] // 2, shots.rate.shape[2] // 2)
    close = (min(half[0], effort.close_px[0]), min(half[1], effort.close_px[1]))
    evaluator = Evaluator(WAVELENGTHS_NM, MODEL_ERROR, fit_lattice(close), wire_shows(wire))
    fit_blocks = blocks(chosen, geometry, _some_samples(chosen, close))
    problem = pose(fit_blocks, evaluator, start_prior(rig, start, wire_shows(wire)))
    fit = fit_diffraction(problem, effort.iterations)
    sources, explained = _all_sources(shots, geometry, replace(evaluator, lattice=fit_lattice(half)), fit)
    size = np.array([rig.camera.columns - 1, rig.camera.rows - 1]) / 2.0
    selection = select_field(shots, sources, explained, held_out, (shots.positions_px() - size) / size)
    return fit_result(shots, geometry, problem, fit, selection, size)


def held_out_positions(count: int) -> Bool[np.ndarray, " positions"]:
    """Every fourth position, the second first, is left out while orders are compared; with three, one of them."""
    return np.arange(count) % 4 == 1


def some_shots(shots: Shots, held_out: Bool[np.ndarray, " positions"], effort: Effort) -> Bool[np.ndarray, " shots"]:
    """Shots for the fit of diffraction: evenly spread over the positions not held out, and over their shifts."""
    usable = np.flatnonzero(~held_out)
    places = usable[np.unique(np.linspace(0, len(usable) - 1, effort.positions).round().astype(int))]
    keep = np.zeros(shots.count, dtype=bool)
    for place in places:
        own = np.flatnonzero(shots.position == place)
        keep[own[np.unique(np.linspace(0, len(own) - 1, effort.shifts).round().astype(int))]] = True
    return keep


def _some_samples(shots: Shots, close: tuple[int, int]) -> Bool[np.ndarray, "shots rows columns"]:
    """All samples about the peak and a seeded draw of the others up to ``close``, as many in every shot."""
    rng = np.random.default_rng(2)
    offsets = np.abs(shots.offsets())
    near = (offsets[..., 0] <= _PEAK_HALF_PX[1]) & (offsets[..., 1] <= _PEAK_HALF_PX[0])
    inside = (offsets[..., 0] <= close[1]) & (offsets[..., 1] <= close[0])
    near &= inside
    far = np.flatnonzero((inside & ~near).ravel())
    chosen = np.tile(near.ravel(), (shots.count, 1))
    for row in chosen:
        row[rng.choice(far, int(len(far) * _ELSEWHERE_SHARE), replace=False)] = True
    return chosen.reshape(shots.rate.shape)


def _all_sources(
    shots: Shots, geometry: Geometry, evaluator: Evaluator, fit: DiffractionFit
) -> tuple[Sources, Float[np.ndarray, "shots rows columns"]]:
    """Places and light of all shots under the fitted model, and what it expects of every sample per unit of light."""
    place, flux, background = shots.centre_px.copy(), np.zeros((shots.count, 3)), np.zeros(shots.count)
    explained = np.zeros(shots.rate.shape)
    for block in blocks(shots, geometry, np.ones(shots.rate.shape, dtype=bool)):
        local, unit = fit_locals(evaluator, fit.theta, block)
        index = np.asarray(block.index)
        real = index >= 0
        place[index[real]] += np.asarray(local.offset_px)[real]
        flux[index[real]], background[index[real]] = np.asarray(local.flux)[real], np.asarray(local.background)[real]
        explained[index[real]] = unit[real].reshape(-1, *shots.rate.shape[1:])
    return with_light_of_peak(shots, Sources(place, flux, background), explained), explained
