"""psf fit: from brackets of an LED at field positions to the kernel of a point source anywhere on the sensor.

The fit first solves for the few parameters of diffraction by the panel, from some of the shots. An image with smooth
coefficients may be added to it or replace it. Positions held out decide whether that helps, and how far light reaches.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from udccal.arguments import check_kind, check_optional
from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Posterior, square_root
from udccal.fitting.engine.misfit import SIGNIFICANT
from udccal.fitting.engine.report import estimates, priors_of, residual_sample
from udccal.fitting.psf.data import PsfData, PsfRules, Shots, about_middle, held_out_positions
from udccal.fitting.psf.diffraction import DiffractionFit, fit_diffraction, pattern_p_value
from udccal.fitting.psf.held_out import (
    STATED,
    KernelError,
    Support,
    choose_support,
    error_patterns,
    kernel_error,
    stated_error,
    wide_support,
    with_support,
)
from udccal.fitting.psf.image import Magnitude
from udccal.fitting.psf.kernel import AXES, BAR_PLACE, BAR_WIDTH, BLUR, CORNER, PITCH, SLANT
from udccal.fitting.psf.orders import Selection, select_field
from udccal.fitting.psf.problem import explain
from udccal.fitting.psf.start import as_numpy, pitch_tolerance, some_shots, start_model, start_prior
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.models.psf import PsfField, fine_oversample
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.quantities import quantity
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus
from udccal.rig import RigDescription

# The first parameters, and which of them are lengths on the panel, which are measured in pitches.
_DIFFRACTION: Final = ("pitch_mm", "column_open", "row_open", "depth_mm", "pupil_diameter_mm")
_BLUR: Final = ("blur_px", "blur_growth_radial", "blur_growth_tangential", "blur_red", "blur_blue")
_NUMBERS: Final = (*_DIFFRACTION, *_BLUR, "depth_ratio")
# Of a bar through openings of (columns, rows), of round corners and of slants, where there are such.
_BAR: Final = ("column_bar_width", "row_bar_width", "column_bar_place", "row_bar_place")
SHAPE: Final = (*_BAR, "corner_radius", "column_slant", "row_slant")
_NAMES: Final = (*_NUMBERS, *SHAPE)
# Diagnostics that say what sigma would be if the model had no deviation; of these numbers.
NOISE_SIGMA: Final = "noise_sigma_"
# Units of diagnostics that have one.
_UNITS: Final = dict.fromkeys(("support_rows", "support_columns"), "px") | {
    f"{NOISE_SIGMA}{name}": "mm" for name in ("depth_mm", "pupil_diameter_mm")
}
_SHAPES: Final = range(CORNER, SLANT.stop)
Cov = Float[np.ndarray, "p p"]
_LENGTHS: Final = np.isin(_NAMES, ("pitch_mm", "depth_mm", "pupil_diameter_mm"))


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
    check_kind(data, PsfData, "Give the crops as one.", FitError)
    check_kind(rig, RigDescription, "Read one by udccal.load_rig(name).", FitError)
    check_kind(geometry, Geometry, "Fit it first, or take nominal_geometry(rig).", FitError)
    check_kind(wire, Wire, "Fit it first.", FitError)
    check_optional(rules, PsfRules, FitError)
    rules = rules or PsfRules()
    data, start = data.known(rules), start_model(rig, geometry, wire, rules)
    unfit = data.unfit(rules)
    if unfit is None and pitch_tolerance(rig) > rules.pitch_least_known:
        pitch = rig.panel.pitch_mm
        known = f"The panel's pitch is {pitch.value:g} ± {pitch.tolerance:g} mm in the rig's description."
        unfit = FitStatus.POOR_FIT, f"{known} Measure it."
    if unfit is not None or data.shots is None:
        status, note = unfit or (FitStatus.TOO_FEW_DATA, "No field position was captured.")
        return FitResult.failed("psf", _field(start, geometry), status, note)
    shots, prior = data.shots.within(rules.half_px), start_prior(rig, start, rules)
    fit = fit_diffraction(shots.pick(some_shots(shots, rules)), geometry, start, prior, rules)
    error = max(fit.model_error, rules.first_model_error)
    sources, explained = explain(fit.problem.evaluator, fit.theta, shots, geometry, error)
    size = np.array([rig.camera.columns - 1, rig.camera.rows - 1]) / 2.0
    selection = select_field(shots, sources, explained, (shots.positions_px() - size) / size, fit.model_error, rules)
    order, support = selection.trial.order, choose_support(selection.trial.compared)
    half_px = support[0].best.fit, support[1].best.fit
    term = replace(
        _field(as_numpy(fit.problem.evaluator.model(fit.theta)), geometry),
        diffraction_fraction=np.float64(not order.free),
        residual=about_middle(selection.image, half_px) if order.free else selection.image,
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
    return _report(data, shots, fit, selection, support, term, rig, rules)


def nominal_psf(rig: RigDescription, geometry: Geometry, wire: Wire) -> PsfField:
    """Return the term that the fit starts from: diffraction by the panel of the rig's description and of the wire.

    Args:
        rig: the panel and the lens as described.
        geometry: the rays of pixels.
        wire: its numbers replace the rig's if the wire fit saw the rows.
    """
    return _field(start_model(rig, geometry, wire), geometry)


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


def _report(
    data: PsfData,
    shots: Shots,
    fit: DiffractionFit,
    selection: Selection,
    support: Support,
    term: PsfField,
    rig: RigDescription,
    rules: PsfRules,
) -> FitResult[PsfField]:
    found, diffracts, problem = selection.trial.compared, not selection.trial.order.free, fit.problem
    held_out_l2, error = found.relative_l2(), kernel_error(selection.everywhere, rules)
    status = FitStatus.NOT_CONVERGED if diffracts and not fit.converged else FitStatus.CONVERGED
    # An error that is no number is poor, too.
    if not float(np.sqrt((held_out_l2**2).mean())) <= rules.poor:
        status = FitStatus.POOR_FIT
    z, used = problem.errors(fit.solution.place), problem.samples.weight > 0
    pattern_p, error_l2 = pattern_p_value(problem.samples, z), float(error.relative_l2(selection.magnitude).mean())
    cov = fit.refuted_cov(error_l2 or np.inf) if pattern_p <= SIGNIFICANT else fit.cov()
    by_parameters = fit.kernel_sigma(cov) if diffracts else 0.0
    stated = stated_error(error, by_parameters, selection.magnitude, rules)
    names = (f"held_out_l2_{name}" for name in ("red", "green", "blue"))
    figures = dict(zip(names, held_out_l2, strict=True)) | {
        "field_positions": shots.positions,
        "pictures": shots.count,
        "samples_left_out": int((shots.weight <= 0).sum()),
        "iterations": fit.iterations,
        "kernel_error_l2": error_l2,
        "residual_degree": selection.trial.order.degree,
        "diffraction_fraction": diffracts,
        "model_error": fit.model_error,
        "efficiency": fit.efficiency(rules, shots.count, len(_NUMBERS)),
        "residual_pattern_p": pattern_p,
        **{STATED + name: value for name, value in vars(stated).items()},
        **_figures(fit, diffracts, support),
    }
    off = _said_to_be_off(stated, selection.magnitude) if error.size else ""
    l2, spread = float(held_out_l2.mean()), float(held_out_l2.std(ddof=1) / np.sqrt(held_out_l2.size))
    numbers: tuple[Estimate, ...] = (Estimate("kernel_relative_l2", l2, spread, "1"),)
    cov_of_numbers = np.array([[spread**2]])
    if diffracts:
        l2_sigma = float(np.hypot(by_parameters, spread))
        numbers, cov_of_numbers = _estimates(fit, cov, l2, l2_sigma, pitch_tolerance(rig))
    compared = [choice for choice in (fit.shape, fit.phase) if choice and len(choice.tried) > 1]
    along = (candidate for choice in support for candidate in choice.candidates)
    term, open_ended = with_support(term, support, rig)
    places = fit.shots.centre_px[np.broadcast_to(problem.samples.index[..., None], used.shape)[used]]
    return FitResult(
        name="psf",
        term=term,
        status=status,
        estimates=numbers,
        cov=cov_of_numbers,
        chi2_dof=fit.chi2_dof if diffracts else float(np.mean((found.residual**2 / found.total)[found.known])),
        samples=problem.used if diffracts else int(found.known.sum()),
        candidates=(*(one for choice in compared for one in choice.candidates), *selection.candidates, *along),
        diagnostics=tuple(Diagnostic(name, float(value), _UNITS.get(name, "1")) for name, value in figures.items()),
        notes=_notes(data, fit if diffracts else None, pattern_p, off, open_ended),
        outliers=fit.outliers,
        residuals=residual_sample(places, z[used]) if diffracts else None,
        posterior=_posterior(fit, cov, error, term, rig),
    )


def _figures(fit: DiffractionFit, diffracts: bool, support: Support) -> dict[str, float]:
    figures = {}
    if fit.phase:
        figures["wire_phase_strength"], figures["wire_phase_strength_sigma"] = fit.phase.best.fit
    figures["support_rows"], figures["support_columns"] = (float(one.best.fit) for one in support)
    by_noise = list(zip(_DIFFRACTION, np.sqrt(np.diag(fit.noise_cov)), strict=False)) if diffracts else []
    return figures | {NOISE_SIGMA + name: sigma for name, sigma in by_noise[1:]}


def _estimates(
    fit: DiffractionFit, whole: Cov, l2: float, l2_sigma: float, tolerance: float
) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "n n"]]:
    """Return the numbers of diffraction, and the error ``l2`` of kernels; ``tolerance`` is the pitch's."""
    prior, found = fit.problem.prior, _numbers_found(fit)
    names = [_NAMES[number] for number in found]
    values, known, sigma, unit = *(v[found] for v in (fit.theta, prior.mean, prior.sigma)), np.ones(len(found))
    # The fit's own parameters are logarithms of the blur and of shapes.
    logs = np.isin(found, (BLUR, *_SHAPES))
    values, known = (np.exp(part, where=logs, out=part.copy()) for part in (values, known))
    unit, sigma = np.where(logs, values, unit), np.where(logs, sigma * known, sigma)
    # Kernels do not tell on which side of the opening's middle a bar is.
    values = np.where(np.isin(found, range(BAR_PLACE.start, BAR_PLACE.stop)), np.abs(values), values)
    # The fit holds the pitch: its tolerance scales all lengths.
    sigma[PITCH] = known[PITCH] * tolerance
    by_pitch = np.where(_LENGTHS[found], values, 0.0) * tolerance
    cov = whole[np.ix_(found, found)] * np.outer(unit, unit) + np.outer(by_pitch, by_pitch)
    # The error of kernels is that of held-out positions, which the numbers do not depend on.
    cov, priors = block_diag(cov, l2_sigma**2), priors_of(tuple(names), known, sigma)
    return estimates("psf", (*names, "kernel_relative_l2"), np.append(values, l2), cov, priors), cov


def _numbers_found(fit: DiffractionFit) -> list[int]:
    """Return the indices of the numbers that the fit has determined; those of a bar and of shapes if there are such."""
    bar = () if fit.bar_axis is None else (BAR_WIDTH.start + fit.bar_axis, BAR_PLACE.start + fit.bar_axis)
    return [*range(len(_NUMBERS)), *bar, *(_SHAPES if fit.shaped else [])]


def _posterior(
    fit: DiffractionFit, cov: Cov, error: KernelError, term: PsfField, rig: RigDescription
) -> Posterior[PsfField]:
    """Return the posterior of the parameters of diffraction, of the pitch, and of the kernel's error without noise.

    All lengths and wavelengths are measured in pitches: the pitch's tolerance scales them together, which does not
    change the kernel. The kernel's error becomes a residual on every pixel of a kernel, whose size follows the kernel
    there, with the signs of sixteen drawn patterns.
    """
    count, evaluator, patterns = fit.theta.size, fit.problem.evaluator, 16 if error.size else 0
    factor = np.zeros((count + 1 + patterns, count + 1 + patterns))
    if term.diffraction_fraction:
        factor[:count, :count] = square_root(cov)
        factor[count, count] = pitch_tolerance(rig)
    factor[count + 1 :, count + 1 :] = np.eye(patterns) / np.sqrt(max(patterns, 1))
    # A result lives long and the data are large: the function below keeps only what it needs.
    size_and_signs = cache(lambda: error_patterns(term, error, rig, patterns))

    def term_at(x: Float[np.ndarray, " n"]) -> PsfField:
        longer = 1.0 + x[count]
        model = as_numpy(evaluator.model(x[:count]))
        scaled = {name: getattr(model, name) * longer for name in ("pitch_mm", "depth_mm", "pupil_diameter_mm")}
        model = replace(model, wavelengths_nm=model.wavelengths_nm * longer, **scaled)
        if not patterns:
            return replace(term, diffraction=model)
        degree, size, signs = size_and_signs()
        residual = size * np.tensordot(x[count + 1 :], signs, axes=1)
        terms, _, rows, columns = term.residual.shape
        down, across = ((n - m) // 2 for n, m in zip(residual.shape[2:], (rows, columns), strict=True))
        residual[:terms, :, down : down + rows, across : across + columns] += term.residual
        return replace(term, diffraction=model, residual=residual, degree=degree)

    return Posterior(np.concatenate([fit.theta, np.zeros(1 + patterns)]), factor, term_at)


def _said_to_be_off(stated: KernelError, magnitude: Magnitude) -> str:
    whole, faint = (100 * float(np.mean(part(magnitude))) for part in (stated.relative_l2, stated.relative_rms))
    where = "where it was not captured, and its faint parts, down to 1e-4 of the peak,"
    return f"The kernel is off by {whole:.2g} % {where} by {faint:.2g} %; sigmas include that."


def _shape_found(theta: Float[np.ndarray, " p"]) -> str:
    radius, columns, rows = np.exp(theta[_SHAPES])
    wider = f"at one end they are wider by {columns:.3f} (columns) and {rows:.3f} (rows) than in their middle"
    return f"The openings' corners have a radius of {radius:.3f} of a period; {wider}."


def _notes(
    data: PsfData, fit: DiffractionFit | None, pattern_p: float, off: str, support: tuple[str, ...]
) -> tuple[str, ...]:
    image = "The blur is not that of a panel's grating: an image carries the kernel; no number of diffraction is known."
    notes = [image, "chi2_dof is of that image at positions held out, and allows for their model error."]
    if fit is not None:
        named = "; ".join(quantity("psf", _NAMES[number]).plain for number in _numbers_found(fit))
        refuted = f"which refutes the model behind these numbers: {named}. {off}".rstrip()
        pattern = f"Residuals of diffraction have a pattern (p = {pattern_p:.1g}), {refuted}"
        off = pattern if pattern_p <= SIGNIFICANT else ""
        notes = ["cov leaves out spectra and field coefficients of the residual."]
        notes += ["chi2_dof is of the fit of diffraction and allows for the model error of its residuals."]
        if fit.bar_axis is not None:
            of, wide = AXES[fit.bar_axis], fit.theta[BAR_WIDTH][fit.bar_axis]
            notes += [f"A bar {wide:.3f} of a period wide crosses the openings of {of}, such as a wire of the panel."]
        if fit.shaped:
            notes += [_shape_found(fit.theta)]
    notes += [off] if off else []
    if data.doubted:
        notes.append(f"{len(data.doubted)} of {data.taken} brackets are in doubt. {data.doubted[0]}")
    left_out, why = data.dark + data.clipped, f"{data.dark} without an LED, {data.clipped} clipped."
    if data.unknown:
        notes.append(f"{data.unknown} pictures were left out: nothing is known of any of their samples.")
    return (*notes, *support, *([f"{left_out} pictures were left out: {why}"] if left_out else []))
