"""psf fit: from brackets of an LED at field positions to the kernel of a point source anywhere on the sensor.

First the few numbers of diffraction by the panel are fitted to some of the shots; then it is tried on the others how
much an image of smooth coefficients, on top of diffraction or instead of it, improves the prediction at positions that
were left out, and how far from the LED these show the kernel's light.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Bool

from udccal.fitting.psf.data import PsfData, Shots, held_out_positions
from udccal.fitting.psf.diffraction import fit_diffraction
from udccal.fitting.psf.held_out import Support, choose_support, compare
from udccal.fitting.psf.image import Sources, about_middle, make_windows, predict
from udccal.fitting.psf.orders import select_field
from udccal.fitting.psf.problem import explain
from udccal.fitting.psf.report import Evidence, as_numpy, report, with_support
from udccal.fitting.psf.start import PsfRules, pitch_tolerance, start_model, start_prior, wire_shows
from udccal.kernels import kernel_size, kernels_at
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.models.psf import PsfField, fine_oversample
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription

_LEAST_POSITIONS: Final = 3
_LEAST_PART: Final = 0.5
# Of each position held out, so many whole pictures are looked at.
_WIDE_PICTURES: Final = 2
# About the source, whole pixels are too coarse for a kernel that is moved by fractions of one; all windows hold it.
_CORE_PX: Final = 4


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
        the result. Its posterior is that of the numbers of diffraction, of the pitch that all lengths are told in, and
        of what positions held out show the kernel to be off by beside noise.
    """
    rules = rules or PsfRules()
    start = start_model(rig, geometry, wire, rules)
    unfit = _unfit(data, rig, rules)
    if unfit is not None or data.shots is None:
        status, note = unfit or (FitStatus.TOO_FEW_DATA, "No field position was captured.")
        return FitResult.failed("psf", _field(start, geometry), status, note)
    shots, seen = data.shots.within(rules.half_px), wire_shows(wire)
    chosen = shots.pick(some_shots(shots, rules))
    chosen = replace(chosen, position=np.unique(chosen.position, return_inverse=True)[1].reshape(-1))
    fit = fit_diffraction(chosen, geometry, start, start_prior(rig, start, seen, rules), rules, seen)
    allowed = max(fit.model_error, rules.first_model_error)
    own, explained = explain(fit.problem, fit.theta, shots, geometry, allowed)
    sources = Sources(own[:, :2], own[:, 2:5], own[:, 5]).with_light_of_peak(shots, explained)
    size = np.array([rig.camera.columns - 1, rig.camera.rows - 1]) / 2.0
    unit = (shots.positions_px() - size) / size
    selection = select_field(shots, sources, explained, unit, fit.model_error, rules)
    model = as_numpy(fit.problem.evaluator.model(fit.theta))
    term = replace(
        _field(model, geometry),
        diffraction_fraction=np.float64(selection.order.share),
        residual=selection.image,
        centre_px=size,
        half_px=size,
        degree=max(selection.order.degree, 0),
    )
    support = selection.support
    # An image that carries the kernel ends with the crops.
    if term.diffraction_fraction and data.shots.half != shots.half:
        held_out = np.flatnonzero(held_out_positions(shots.positions))
        looked_at = np.concatenate([np.flatnonzero(shots.position == p)[:_WIDE_PICTURES] for p in held_out])
        support = wide_support(data.shots.pick(looked_at), selection.sources.pick(looked_at), term, rig)
    known = Evidence(shots, data, rig, fit, selection, support, pitch_tolerance(rig))
    return report(known, with_support(term, support, rig), rules)


def nominal_psf(rig: RigDescription, geometry: Geometry, wire: Wire) -> PsfField:
    """What the fit starts from: diffraction by the panel as the rig's description and the wire have it."""
    return _field(start_model(rig, geometry, wire), geometry)


def some_shots(shots: Shots, rules: PsfRules) -> Bool[np.ndarray, " shots"]:
    """Shots for the fit of diffraction: evenly spread over the positions not held out, and over their shifts."""
    usable = np.flatnonzero(~held_out_positions(shots.positions))
    places = usable[np.unique(np.linspace(0, len(usable) - 1, rules.positions).round().astype(int))]
    keep = np.zeros(shots.count, dtype=bool)
    for place in places:
        own = np.flatnonzero(shots.position == place)
        keep[own[np.unique(np.linspace(0, len(own) - 1, rules.shifts).round().astype(int))]] = True
    return keep


def _unfit(data: PsfData, rig: RigDescription, rules: PsfRules) -> tuple[FitStatus, str] | None:
    """Why there can be no fit."""
    most = (1 - _LEAST_PART) * max(data.taken, 1)
    if data.clipped > most:
        return FitStatus.SATURATED, f"{data.clipped} of {data.taken} pictures are clipped."
    if data.dark > most:
        return FitStatus.TOO_DARK, f"{data.dark} of {data.taken} pictures show no LED."
    if data.shots is not None and data.shots.positions < _LEAST_POSITIONS:
        needed = f"{_LEAST_POSITIONS} are needed at least."
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
    wide, position = wide.within((rows // 2, columns // 2)), np.unique(wide.position, return_inverse=True)[1]
    places = np.stack([wide.centre_px[position == p].mean(axis=0) for p in np.unique(position)])
    kernels = about_middle(kernels_at(term, places, rows, columns).astype(np.float64), wide.half)
    at_position = np.eye(len(places))[position]
    windows = make_windows(wide, sources, np.zeros_like(wide.rate), at_position, 0.0)
    light = np.asarray(predict(windows, kernels))
    windows = make_windows(wide, sources.with_light_of_peak(wide, light), light, at_position, 0.0)
    found = compare(wide, windows, light * np.asarray(windows.flux), np.arange(wide.count))
    core = (np.abs(wide.offsets()) <= _CORE_PX).all(axis=-1)
    return choose_support(replace(found, known=found.known & ~core))
