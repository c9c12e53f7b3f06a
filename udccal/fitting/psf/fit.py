"""psf fit: from brackets of an LED at field positions to the kernel of a point source anywhere on the sensor.

First the few numbers of diffraction by the panel are fitted to some of the shots; then it is tried on the others how
much an image of smooth coefficients, on top of diffraction or instead of it, improves the prediction at positions that
were left out, and how far from the LED these show the kernel's light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from udccal.fitting.psf.evidence import NAMES, diffraction_alone, failed, fit_result, with_support
from udccal.fitting.psf.explained import explain
from udccal.fitting.psf.field import fit_field
from udccal.fitting.psf.posterior import PsfPosterior, posterior
from udccal.fitting.psf.read import read_shots, window_half
from udccal.fitting.psf.samples import share_of_information
from udccal.fitting.psf.select import Selection, select_field
from udccal.fitting.psf.shots import Shots
from udccal.fitting.psf.start import LEAST_KNOWN, pitch_tolerance, start_model, start_prior, wire_shows
from udccal.fitting.psf.wide import wide_support
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription
from udccal.sessions.store import Session

_LEAST_POSITIONS = 3
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Effort:
    """What the fit may spend: more is slower and more accurate.

    Attributes:
        positions, shifts: so many field positions, and pictures of each, go into the fit of diffraction.
        half_px: largest window (rows, columns) to either side of the LED; the regions captured may bound it further.
        close_px: the same for the fit of diffraction, whose time grows with it.
        far_share: of the samples away from the peak, so many go into it; all of those about the peak do.
        iterations: at most, of the fit of diffraction.
    """

    positions: int = 10
    shifts: int = 3
    half_px: tuple[int, int] = (48, 16)
    close_px: tuple[int, int] = (40, 14)
    far_share: float = 1 / 6
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
    if reading.shots is None:
        return failed(start, geometry, FitStatus.TOO_FEW_DATA, "No field position was captured.")
    parts = _fit(reading.shots, session.rig, geometry, wire, effort)
    result, selection = parts.result, parts.selection
    if selection is not None:
        held_out = held_out_positions(int(reading.shots.position.max()) + 1)
        wide = wide_support(session, noise, wire, reading, selection.sources, result.term, held_out)
        result = with_support(result, wide or selection.support, session.rig)
    left_out = reading.clipped + reading.dark
    note = f"{left_out} pictures were left out: {reading.dark} without an LED, {reading.clipped} clipped."
    return replace(result, notes=(*result.notes, note)) if left_out else result


def nominal_psf(rig: RigDescription, geometry: Geometry, wire: Wire) -> PsfField:
    """What the fit starts from: diffraction by the panel as the rig's description and the wire have it."""
    return diffraction_alone(start_model(rig, geometry, wire), geometry)


@dataclass(frozen=True)
class FittedPsf:
    """The result, and what ``psf_sigma`` needs to say how sure the kernel is at a field point.

    ``posterior`` is None where there is no fit, or none with diffraction in it.
    """

    result: FitResult[PsfField]
    posterior: PsfPosterior | None


def fit_shots(
    shots: Shots, rig: RigDescription, geometry: Geometry, wire: Wire, effort: Effort | None = None
) -> FitResult[PsfField]:
    """Fit the psf term to crops about the LED; see ``fit_psf``."""
    return fit_shots_fully(shots, rig, geometry, wire, effort).result


def fit_shots_fully(
    shots: Shots, rig: RigDescription, geometry: Geometry, wire: Wire, effort: Effort | None = None
) -> FittedPsf:
    """As ``fit_shots``, with the posterior of the numbers of diffraction."""
    parts = _fit(shots, rig, geometry, wire, effort or Effort())
    if parts.selection is None:
        return FittedPsf(parts.result, None)
    return FittedPsf(with_support(parts.result, parts.selection.support, rig), parts.posterior)


@dataclass(frozen=True)
class _Parts:
    """The result without a support, and what it stands on; nothing where there is no fit."""

    result: FitResult[PsfField]
    posterior: PsfPosterior | None = None
    selection: Selection | None = None


@in_float64
def _fit(shots: Shots, rig: RigDescription, geometry: Geometry, wire: Wire, effort: Effort) -> _Parts:
    start = start_model(rig, geometry, wire)
    count = int(shots.position.max()) + 1
    if count < _LEAST_POSITIONS:
        note = f"{count} field positions were captured; {_LEAST_POSITIONS} are needed at least."
        return _Parts(failed(start, geometry, FitStatus.TOO_FEW_DATA, note))
    if pitch_tolerance(rig) > LEAST_KNOWN:
        pitch = rig.panel.pitch_mm
        note = f"The panel's pitch is {pitch.value:g} ± {pitch.tolerance:g} mm in the rig's description. Measure it."
        return _Parts(failed(start, geometry, FitStatus.POOR_FIT, note))
    held_out = held_out_positions(count)
    chosen = shots.pick(some_shots(shots, held_out, effort))
    chosen = replace(chosen, position=np.unique(chosen.position, return_inverse=True)[1].reshape(-1))
    half = (shots.rate.shape[1] // 2, shots.rate.shape[2] // 2)
    close = (min(half[0], effort.close_px[0]), min(half[1], effort.close_px[1]))
    seen = wire_shows(wire)
    field = fit_field(chosen, geometry, start_prior(rig, start, seen), close, effort.far_share, effort.iterations, seen)
    sources, explained = explain(shots, geometry, field.diffraction, half)
    size = np.array([rig.camera.columns - 1, rig.camera.rows - 1]) / 2.0
    unit = (shots.positions_px() - size) / size
    selection = select_field(shots, sources, explained, held_out, unit, field.diffraction.model_error)
    used = share_of_information(field.diffraction, field.shots, geometry, close, shots.count, len(NAMES))
    result = fit_result(shots, geometry, field, selection, size, used, pitch_tolerance(rig))
    known = posterior(field.diffraction, geometry, selection.error) if selection.share else None
    return _Parts(result, known, selection)


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
