"""psf fit: from brackets of an LED at field positions to the kernel of a point source anywhere on the sensor.

First the few numbers of diffraction by the panel are fitted to some of the shots; then it is tried on the others how
much an image of smooth coefficients, on top of diffraction or instead of it, improves the prediction at positions that
were left out, and how far from the LED these show the kernel's light.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.psf.data import PsfData, PsfRules, Shots, about_middle, held_out_positions
from udccal.fitting.psf.diffraction import fit_diffraction
from udccal.fitting.psf.held_out import Support, choose_support, compare
from udccal.fitting.psf.image import Sources, make_windows, predict
from udccal.fitting.psf.kernel import HEAD, pack
from udccal.fitting.psf.orders import select_field
from udccal.fitting.psf.problem import explain
from udccal.fitting.psf.report import as_numpy, report
from udccal.kernels import kernel_size, kernels_at
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.models.psf import PsfField, fine_oversample
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription

WAVELENGTHS_NM: Final = np.linspace(400.0, 700.0, 13)


@in_float64
def fit_psf(
    data: PsfData, rig: RigDescription, geometry: Geometry, wire: Wire, rules: PsfRules | None = None
) -> FitResult[PsfField]:
    """Fit the psf term to crops about the LED.

    Args:
        data: what was captured; see ``read_psf``.
        rig: the panel and the lens as built, for the start and the prior.
        geometry: where pixels look.
        wire: a start for the panel's numbers.
        rules: what the fit may spend, and its constants.

    Returns:
        the result. Its posterior is that of the numbers of diffraction, of the pitch that all lengths are measured in,
        and of what positions held out show the kernel to be off by beside noise.
    """
    rules = rules or PsfRules()
    start = start_model(rig, geometry, wire, rules)
    unfit = _unfit(data, rig, rules)
    if unfit is not None or data.shots is None:
        status, note = unfit or (FitStatus.TOO_FEW_DATA, "No field position was captured.")
        return FitResult.failed("psf", _field(start, geometry), status, note)
    shots = data.shots.within(rules.half_px)
    fit = fit_diffraction(shots.pick(some_shots(shots, rules)), geometry, start, start_prior(rig, start, rules), rules)
    allowed = max(fit.model_error, rules.first_model_error)
    own, explained = explain(fit.problem, fit.theta, shots, geometry, allowed)
    sources = Sources(own[:, :2], own[:, 2:5], own[:, 5]).with_light_of_peak(shots, explained)
    size = np.array([rig.camera.columns - 1, rig.camera.rows - 1]) / 2.0
    selection = select_field(shots, sources, explained, (shots.positions_px() - size) / size, fit.model_error, rules)
    order, support = selection.trial.order, selection.support
    term = replace(
        _field(as_numpy(fit.problem.evaluator.model(fit.theta)), geometry),
        diffraction_fraction=np.float64(not order.free),
        residual=selection.image,
        centre_px=size,
        half_px=size,
        degree=max(order.degree, 0),
    )
    # An image that carries the kernel ends with the crops.
    if not order.free and data.shots.half != shots.half:
        held_out = np.flatnonzero(held_out_positions(shots.positions))
        # Two whole pictures of each of these positions are enough.
        looked_at = np.concatenate([np.flatnonzero(shots.position == p)[:2] for p in held_out])
        support = wide_support(data.shots.pick(looked_at), selection.trial.sources.pick(looked_at), term, rig)
    return report(data, fit, replace(selection, support=support), with_support(term, support, rig), rig, rules)


def nominal_psf(rig: RigDescription, geometry: Geometry, wire: Wire) -> PsfField:
    """What the fit starts from: diffraction by the panel as the rig's description and the wire have it.

    Args:
        rig: the panel and the lens as described.
        geometry: where pixels look.
        wire: where it shows, its numbers replace the rig's.
    """
    return _field(start_model(rig, geometry, wire), geometry)


def some_shots(shots: Shots, rules: PsfRules) -> Bool[np.ndarray, " shots"]:
    """Shots for the fit of diffraction: evenly spread over the positions not held out, and over their shifts."""

    def spread(items: np.ndarray, most: int) -> np.ndarray:
        return items[np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]

    keep = np.zeros(shots.count, dtype=bool)
    for place in spread(np.flatnonzero(~held_out_positions(shots.positions)), rules.positions):
        keep[spread(np.flatnonzero(shots.position == place), rules.shifts)] = True
    return keep


def _unfit(data: PsfData, rig: RigDescription, rules: PsfRules) -> tuple[FitStatus, str] | None:
    """Why there can be no fit."""
    most = 0.5 * max(data.taken, 1)
    if data.clipped > most:
        return FitStatus.SATURATED, f"{data.clipped} of {data.taken} pictures are clipped."
    if data.dark > most:
        return FitStatus.TOO_DARK, f"{data.dark} of {data.taken} pictures show no LED."
    if data.shots is not None and data.shots.positions < rules.least_positions:
        needed = f"{rules.least_positions} are needed at least."
        return FitStatus.TOO_FEW_DATA, f"{data.shots.positions} field positions were captured; {needed}"
    if pitch_tolerance(rig) > rules.pitch_least_known:
        pitch = rig.panel.pitch_mm
        known = f"The panel's pitch is {pitch.value:g} ± {pitch.tolerance:g} mm in the rig's description."
        return FitStatus.POOR_FIT, f"{known} Measure it."
    return None


def _field(model: Diffraction, geometry: Geometry) -> PsfField:
    """Without a residual."""
    half = np.maximum(np.asarray(geometry.principal_point_px, dtype=np.float64), 1.0)
    return PsfField(
        geometry=geometry,
        diffraction=model,
        diffraction_fraction=np.float64(1.0),
        residual=np.zeros((1, 3, 1, 1)),
        centre_px=half,
        half_px=half,
        support_px=2 * half + 1,
        degree=0,
        fine=fine_oversample(float(model.pupil_diameter_mm), float(np.mean(np.asarray(geometry.focal_px)))),
    )


def wide_support(wide: Shots, sources: Sources, term: PsfField, rig: RigDescription) -> Support:
    """The support from whole pictures of positions held out, whose places and light are ``sources``."""
    # Of the size that a profile holds: compiled but once.
    rows, columns = kernel_size(rig)
    wide = wide.within((rows // 2, columns // 2))
    kernels = about_middle(kernels_at(term, wide.positions_px(), rows, columns).astype(np.float64), wide.half)
    at_position = np.eye(wide.positions)[wide.position]
    windows = make_windows(wide, sources, np.zeros_like(wide.rate), at_position, 0.0)
    light = np.asarray(predict(windows, kernels))
    windows = make_windows(wide, sources.with_light_of_peak(wide, light), light, at_position, 0.0)
    found = compare(wide, windows, light * np.asarray(windows.flux), np.arange(wide.count))
    # About the source, whole pixels are too coarse for a kernel that is moved by fractions of one; all windows hold it.
    core = (np.abs(wide.offsets()) <= 4).all(axis=-1)
    return choose_support(replace(found, known=found.known & ~core))


def with_support(term: PsfField, support: Support, rig: RigDescription) -> PsfField:
    """The term with how far its kernel was seen.

    Where no end of diffraction was seen, it goes on over the whole sensor; an image ends where it ends.
    """
    size = (rig.camera.rows, rig.camera.columns)
    onward = (seen and bool(term.diffraction_fraction) for seen in support.open_ended)
    down, across = (most if on else half for half, on, most in zip(support.half_px, onward, size, strict=True))
    return replace(term, support_px=np.array([across, down], dtype=np.float64))


def start_model(rig: RigDescription, geometry: Geometry, wire: Wire, rules: PsfRules | None = None) -> Diffraction:
    """The rig's nominal panel and pupil, or the wire's where the wire shows; the spectra of common colour filters.

    Args:
        rig: the panel and the lens as described.
        geometry: has the pupil's place, in mm.
        wire: its numbers are in pitches of the panel.
        rules: the blur, and which pitches are well known.
    """
    panel, pitch, rules = rig.panel, rig.panel.pitch_mm.value, rules or PsfRules()
    nodes = wavelengths_nm(rig, rules)
    responses = np.exp(-0.5 * ((nodes - np.array([[600.0], [535.0], [460.0]])) / 45.0) ** 2) + 1e-3
    pupil = np.asarray(geometry.pupil_mm, dtype=np.float64)
    if seen := wire_shows(wire):
        opened, offset = (wire.column_open, wire.row_open), wire.offset_periods
        lengths = (wire.depth_per_pitch, wire.footprint_per_pitch, wire.standoff_per_pitch)
    else:
        opened, offset = (panel.column_open.value, panel.row_open.value), pupil[:2] / pitch
        lengths = (panel.depth_mm.value / pitch, rig.pupil_diameter_mm / pitch, -pupil[2] / pitch)
    return Diffraction(
        pitch_mm=np.float64(pitch),
        openings=np.array([float(part) for part in opened]),
        depth_mm=np.float64(float(lengths[0]) * pitch),
        pupil_diameter_mm=np.float64(float(lengths[1]) * pitch),
        blur_px=np.float64(rules.blur_px),
        offset_periods=np.asarray(offset, dtype=np.float64),
        standoff_per_pitch=np.float64(float(lengths[2])),
        visibility=np.float64(seen),
        wavelengths_nm=nodes,
        spectrum=responses / responses.sum(axis=1, keepdims=True),
    )


def wire_shows(wire: Wire) -> bool:
    """Whether the wire fit saw the rows: only then is it known where the pupil's footprint lies on them."""
    return np.shape(wire.harmonics)[0] > 0


def wavelengths_nm(rig: RigDescription, rules: PsfRules) -> Float[np.ndarray, " nodes"]:
    """Nodes of the spectra: daylight's, or what it looks like behind a panel whose pitch is off by its tolerance."""
    relative = min(pitch_tolerance(rig), rules.pitch_least_known)
    if relative <= rules.pitch_well_known:
        return WAVELENGTHS_NM
    first, last = WAVELENGTHS_NM[0] * (1 - relative), WAVELENGTHS_NM[-1] * (1 + relative)
    return np.linspace(first, last, round((last - first) / (WAVELENGTHS_NM[1] - WAVELENGTHS_NM[0])) + 1)


def pitch_tolerance(rig: RigDescription) -> float:
    """Of the pitch, relatively: the psf measures all lengths in pitches."""
    return rig.panel.pitch_mm.tolerance / rig.panel.pitch_mm.value


def start_prior(rig: RigDescription, start: Diffraction, rules: PsfRules | None = None) -> Prior:
    """Tolerances of the rig on the panel's numbers, tighter where the wire has measured them; smooth spectra.

    Diffraction shows wavelength / pitch only. The pitch is therefore held where the rig has it, and the spectra are
    free to move: a pitch that is off by its tolerance then comes out as wavelengths that are.

    Args:
        rig: its tolerances are taken for standard deviations.
        start: the mean; its ``visibility`` says whether the wire has measured the panel's numbers.
        rules: how much tighter, and the sigmas of what the rig does not describe.
    """
    panel, theta, rules = rig.panel, pack(start), rules or PsfRules()
    tighter = rules.wire_tolerance if start.visibility else 1.0
    sigma = [
        rules.pitch_tolerance * min(panel.pitch_mm.tolerance, rules.pitch_well_known * panel.pitch_mm.value),
        tighter * panel.column_open.tolerance,
        tighter * panel.row_open.tolerance,
        tighter * panel.depth_mm.tolerance,
        tighter * 2.0 * rig.pupil_diameter_mm * rig.lens.f_number.tolerance / rig.lens.f_number.value,
        rules.blur_log_sigma,
        *(3 * (rules.footprint_periods,)),
    ]
    roots = [np.eye(HEAD, theta.size) / np.maximum(np.array(sigma), 1e-6)[:, None]]
    for pick in np.eye(theta.size)[HEAD:].reshape(3, -1, theta.size):
        roots += [np.diff(pick, 2, axis=0) / rules.spectrum_bend, pick / rules.spectrum_sigma]
    return Prior(theta.copy(), np.concatenate(roots))
