"""psf fit: from brackets of an LED at field positions to the kernel of a point source anywhere on the sensor.

The fit first solves for the few parameters of diffraction by the panel, from some of the shots. An image with smooth
coefficients may then be added to diffraction or replace it. Positions that were held out decide whether it improves the
prediction, and how far from the LED the kernel reaches.
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
        data: crops in e-/s; see ``read_psf``.
        rig: the panel and the lens as built, for the start and the prior.
        geometry: the rays of pixels.
        wire: a start for the panel's numbers.
        rules: effort and constants of the fit.

    Returns:
        The result. Its posterior covers the parameters of diffraction, the pitch, which scales all lengths, and the
        error of the kernel that positions held out show in addition to noise. Data that cannot be fitted give a status
        and a note instead of an exception.
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
    # An image without diffraction ends with the crops.
    if not order.free and data.shots.half != shots.half:
        held_out = np.flatnonzero(held_out_positions(shots.positions))
        # Two whole pictures of each of these positions are enough.
        looked_at = np.concatenate([np.flatnonzero(shots.position == p)[:2] for p in held_out])
        support = wide_support(data.shots.pick(looked_at), selection.trial.sources.pick(looked_at), term, rig)
    return report(data, fit, replace(selection, support=support), with_support(term, support, rig), rig, rules)


def nominal_psf(rig: RigDescription, geometry: Geometry, wire: Wire) -> PsfField:
    """Return the term that the fit starts from: diffraction by the panel of the rig's description and of the wire.

    Args:
        rig: the panel and the lens as described.
        geometry: the rays of pixels.
        wire: its numbers replace the rig's if the wire fit saw the rows.
    """
    return _field(start_model(rig, geometry, wire), geometry)


def some_shots(shots: Shots, rules: PsfRules) -> Bool[np.ndarray, " shots"]:
    """Choose shots for the fit of diffraction, evenly over the positions not held out and over their shifts."""

    def spread(items: np.ndarray, most: int) -> np.ndarray:
        return items[np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]

    keep = np.zeros(shots.count, dtype=bool)
    for place in spread(np.flatnonzero(~held_out_positions(shots.positions)), rules.positions):
        keep[spread(np.flatnonzero(shots.position == place), rules.shifts)] = True
    return keep


def _unfit(data: PsfData, rig: RigDescription, rules: PsfRules) -> tuple[FitStatus, str] | None:
    """Return why there can be no fit, or None."""
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
    """Return a term of diffraction without a residual."""
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
    """Choose the support from whole pictures of positions held out, whose places and light are ``sources``."""
    # The size that a profile holds needs no second compilation.
    rows, columns = kernel_size(rig)
    wide = wide.within((rows // 2, columns // 2))
    kernels = about_middle(kernels_at(term, wide.positions_px(), rows, columns).astype(np.float64), wide.half)
    at_position = np.eye(wide.positions)[wide.position]
    windows = make_windows(wide, sources, np.zeros_like(wide.rate), at_position, 0.0)
    light = predict(windows, kernels)
    windows = make_windows(wide, sources.with_light_of_peak(wide, light), light, at_position, 0.0)
    found = compare(wide, windows, light * windows.flux, np.arange(wide.count))
    # Near the source, whole pixels are too coarse for a kernel that moves by fractions of one; all windows hold it.
    core = (np.abs(wide.offsets()) <= 4).all(axis=-1)
    return choose_support(replace(found, known=found.known & ~core))


def with_support(term: PsfField, support: Support, rig: RigDescription) -> PsfField:
    """Return the term with this support of its kernel.

    Diffraction reaches over the whole sensor where the pictures show no end of it; an image ends at the support.
    """
    size = (rig.camera.rows, rig.camera.columns)
    onward = (seen and bool(term.diffraction_fraction) for seen in support.open_ended)
    down, across = (most if on else half for half, on, most in zip(support.half_px, onward, size, strict=True))
    return replace(term, support_px=np.array([across, down], dtype=np.float64))


def start_model(rig: RigDescription, geometry: Geometry, wire: Wire, rules: PsfRules | None = None) -> Diffraction:
    """Return the start of diffraction: the wire's panel and pupil, or the rig's if no wire was seen.

    Args:
        rig: the panel and the lens as described; lengths in mm.
        geometry: has the pupil's position, in mm.
        wire: its numbers are in pitches of the panel.
        rules: the blur, and which pitches are well known. Spectra start as those of common colour filters.
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
    """Return whether the wire fit saw the rows: only then the place of the pupil's footprint on them is known."""
    return np.shape(wire.harmonics)[0] > 0


def wavelengths_nm(rig: RigDescription, rules: PsfRules) -> Float[np.ndarray, " nodes"]:
    """Return the spectra's nodes in nm: those of daylight, wider by the pitch's tolerance where that is large."""
    relative = min(pitch_tolerance(rig), rules.pitch_least_known)
    if relative <= rules.pitch_well_known:
        return WAVELENGTHS_NM
    first, last = WAVELENGTHS_NM[0] * (1 - relative), WAVELENGTHS_NM[-1] * (1 + relative)
    return np.linspace(first, last, round((last - first) / (WAVELENGTHS_NM[1] - WAVELENGTHS_NM[0])) + 1)


def pitch_tolerance(rig: RigDescription) -> float:
    """Return the relative tolerance of the pitch, in which the psf measures all lengths."""
    return rig.panel.pitch_mm.tolerance / rig.panel.pitch_mm.value


def start_prior(rig: RigDescription, start: Diffraction, rules: PsfRules | None = None) -> Prior:
    """Return the prior: the rig's tolerances, tighter for what the wire has measured, and smooth spectra.

    Diffraction depends on wavelength / pitch only. The pitch is therefore held at the rig's value, and the spectra are
    free to move: an error of the pitch then appears as an error of the wavelengths.

    Args:
        rig: its tolerances are taken for standard deviations.
        start: the mean; its ``visibility`` says whether the wire has measured the panel's numbers.
        rules: factor of the tolerances after the wire's fit, and sigmas of parameters that the rig does not describe.
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
