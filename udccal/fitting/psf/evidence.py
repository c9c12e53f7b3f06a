"""The psf fit's result: the term, its estimates with sigma, and how well it predicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf.blocks import BLUR
from udccal.fitting.psf.diffraction import DiffractionFit, expected_light, fitted_model
from udccal.fitting.psf.field import FieldFit
from udccal.fitting.psf.posterior import full_cov, light_and_slopes
from udccal.fitting.psf.select import Selection
from udccal.fitting.psf.shots import Shots
from udccal.fitting.psf.support import Support
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.models.psf import PsfField, fine_oversample
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus, ResidualSample
from udccal.rig import RigDescription

_POOR = 0.2
# A pattern less likely than this by chance is said.
_PATTERN_P = 1e-3
_MOST_RESIDUALS = 6000
NAMES = ("pitch", "column_open_fraction", "row_open_fraction", "structure_thickness", "pupil_diameter", "blur")
_UNITS = ("mm", "1", "1", "mm", "mm", "px")

_DIFFRACTION_NOTES = (
    "cov covers the numbers of diffraction; field coefficients of the residual and spectra are left out of it.",
    "chi2_dof is of the fit of diffraction and allows for the model error that its residuals tell.",
)
# Which of the numbers are lengths on the panel, told in pitches.
_LENGTHS = np.array([name in ("pitch", "structure_thickness", "pupil_diameter") for name in NAMES])
_FREE_NOTES = (
    "The blur is not that of a panel's grating: an image carries the kernel, no number of diffraction is known.",
    "chi2_dof is of that image at positions held out, and allows for the model error that these tell.",
)


def fit_result(
    shots: Shots,
    geometry: Geometry,
    field: FieldFit,
    selection: Selection,
    size: Float[np.ndarray, "2"],
    efficiency: float,
    pitch_tolerance: float,
) -> FitResult[PsfField]:
    """Everything together.

    ``size`` is the sensor's (half width, half height) in px, also its centre; ``pitch_tolerance`` by what
    fraction the pitch, which was held so that the spectra could move, may be off.
    """
    fit = field.diffraction
    term = PsfField(
        geometry=geometry,
        diffraction=fitted_model(fit.problem.evaluator, fit.theta),
        diffraction_share=np.float64(selection.share),
        residual=selection.image,
        centre_px=size,
        half_px=size,
        support_px=2 * size + 1,
        degree=max(selection.degree, 0),
        fine=fine_oversample(float(fit.theta[4]), float(np.mean(np.asarray(geometry.focal)))),
    )
    worst = float(np.sqrt((selection.held_out**2).mean()))
    status = FitStatus.CONVERGED
    if not np.isfinite(worst) or worst > _POOR:
        status = FitStatus.POOR_FIT
    elif selection.share and not fit.converged:
        status = FitStatus.NOT_CONVERGED
    estimates, cov = _estimates(fit, selection, pitch_tolerance)
    return FitResult(
        name="psf",
        term=term,
        status=status,
        estimates=estimates,
        cov=cov,
        chi2_dof=fit.chi2_dof if selection.share else selection.chi2_dof,
        samples=fit.problem.samples if selection.share else selection.samples,
        candidates=(*(field.phase.candidates if field.phase else ()), *selection.candidates),
        diagnostics=(*_diagnostics(shots, fit, selection), *_of_diffraction(field, efficiency)),
        notes=_notes(fit, selection),
        outliers=fit.outliers,
        residuals=_residuals(field) if selection.share else None,
    )


def _notes(fit: DiffractionFit, selection: Selection) -> tuple[str, ...]:
    if not selection.share:
        return _FREE_NOTES
    if fit.pattern_p > _PATTERN_P:
        return _DIFFRACTION_NOTES
    off = f"The kernel is off by {100 * selection.relative_l2:.2g} % where it was not captured; sigmas include that."
    pattern = f"Residuals of diffraction have a pattern (p = {fit.pattern_p:.1g})."
    return (*_DIFFRACTION_NOTES, f"{pattern} {off}" if selection.error.size else pattern)


def _residuals(field: FieldFit) -> ResidualSample:
    """Of evenly drawn samples of the fit of diffraction, at the places of their LED, the model error in their sigma."""
    problem, point = field.diffraction.problem, field.diffraction.point
    places, z = [], []
    lights = expected_light(problem, point)
    for block, local, light in zip(problem.blocks, point.local, lights, strict=True):
        weight = np.asarray(block.weight)
        error = np.asarray(block.rate) - light - np.asarray(local.background)[:, None]
        shot, _ = used = np.nonzero(weight > 0)
        places.append(field.shots.centre_px[np.asarray(block.index)[shot]])
        z.append((error * np.sqrt(weight))[used])
    positions, values = np.concatenate(places), np.concatenate(z)
    drawn = np.s_[:: max(1, -(-len(values) // _MOST_RESIDUALS))]
    return ResidualSample(positions[drawn], values[drawn])


def diffraction_alone(model: Diffraction, geometry: Geometry) -> PsfField:
    """A field without a residual."""
    half = np.maximum(np.asarray(geometry.centre, dtype=np.float64), 1.0)
    return PsfField(
        geometry=geometry,
        diffraction=model,
        diffraction_share=np.float64(1.0),
        residual=np.zeros((1, 3, 1, 1)),
        centre_px=half,
        half_px=half,
        support_px=2 * half + 1,
        degree=0,
        fine=fine_oversample(float(model.pupil_mm), float(np.mean(np.asarray(geometry.focal)))),
    )


def with_support(result: FitResult[PsfField], support: Support, rig: RigDescription) -> FitResult[PsfField]:
    """The result with a term that says how far its kernel was seen.

    Where no end of diffraction was seen, it goes on over the whole sensor; an image ends where it ends.
    """
    down, across = support.half_px
    goes_on = [seen and bool(result.term.diffraction_share) for seen in support.open_ended]
    reach = [rig.camera.columns if goes_on[1] else across, rig.camera.rows if goes_on[0] else down]
    seen = (Diagnostic("support_rows", float(down), "px"), Diagnostic("support_columns", float(across), "px"))
    along = " and ".join(name for name, on in zip(("columns", "rows"), goes_on, strict=True) if on)
    note = f"Along {along} light was seen as far as was looked; beyond, the kernel is diffraction as fitted."
    return replace(
        result,
        term=replace(result.term, support_px=np.array(reach, dtype=np.float64)),
        candidates=(*result.candidates, *support.candidates),
        diagnostics=(*result.diagnostics, *seen),
        notes=(*result.notes, *([note] if along else [])),
    )


def failed(start: Diffraction, geometry: Geometry, status: FitStatus, note: str) -> FitResult[PsfField]:
    """No fit: the term is the nominal diffraction."""
    return FitResult.failed("psf", diffraction_alone(start, geometry), status, note)


def _estimates(
    fit: DiffractionFit, selection: Selection, pitch_tolerance: float
) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "n n"]]:
    error = float(selection.held_out.mean())
    spread = float(selection.held_out.std(ddof=1) / np.sqrt(selection.held_out.size))
    if not selection.share:
        return (Estimate("kernel_relative_l2", error, spread, "1"),), np.array([[spread**2]])
    whole = full_cov(fit)
    kernel = Estimate("kernel_relative_l2", error, float(np.hypot(_kernel_sigma(fit, whole), spread)), "1")
    # The fit's own parameter is the logarithm of the blur.
    values, unit = fit.theta[: len(NAMES)].copy(), np.ones(len(NAMES))
    values[BLUR] = unit[BLUR] = np.exp(fit.theta[BLUR])
    cov = whole[: len(NAMES), : len(NAMES)] * np.outer(unit, unit)
    by_pitch = np.where(_LENGTHS, values, 0.0) * pitch_tolerance
    cov += np.outer(by_pitch, by_pitch)
    sigma = np.sqrt(np.diag(cov))
    numbers = tuple(Estimate(n, float(v), float(s), u) for n, v, s, u in zip(NAMES, values, sigma, _UNITS, strict=True))
    return (*numbers, kernel), cov


def _kernel_sigma(fit: DiffractionFit, cov: Float[np.ndarray, "p p"]) -> float:
    """Relative L2 spread of what the first position expects of its samples, in all colours."""
    block, evaluator = fit.problem.blocks[0], fit.problem.evaluator
    at = (np.asarray(block.points)[0], np.asarray(block.density)[0], block.disc_px)
    found = light_and_slopes(evaluator, fit.theta, block.frame, evaluator.lattice, *at)
    light, slopes = (np.asarray(part) for part in found)
    variance = float(np.einsum("pnc,pq,qnc->", slopes, cov, slopes, optimize=True))
    return float(np.sqrt(max(variance, 0.0) / (light**2).sum()))


def _of_diffraction(field: FieldFit, efficiency: float) -> tuple[Diagnostic, ...]:
    fit = field.diffraction
    made = [
        Diagnostic("model_error", fit.model_error, "1"),
        Diagnostic("efficiency", efficiency, "1"),
        Diagnostic("residual_pattern_p", fit.pattern_p, "1"),
    ]
    if field.phase:
        made.append(Diagnostic("wire_phase_strength", field.phase.strength, "1"))
        made.append(Diagnostic("wire_phase_strength_sigma", field.phase.sigma, "1"))
    return tuple(made)


def _diagnostics(shots: Shots, fit: DiffractionFit, selection: Selection) -> tuple[Diagnostic, ...]:
    known = shots.weight > 0
    left_out = float((~known).sum())
    names = ("red", "green", "blue")
    return (
        *(Diagnostic(f"held_out_l2_{n}", float(v), "1") for n, v in zip(names, selection.held_out, strict=True)),
        Diagnostic("led_position_sigma", _position_sigma(shots, selection), "px"),
        Diagnostic("field_positions", float(shots.position.max() + 1), "1"),
        Diagnostic("pictures", float(shots.count), "1"),
        Diagnostic("samples_left_out", left_out, "1"),
        Diagnostic("iterations", float(fit.point.iterations), "1"),
        Diagnostic("kernel_error_l2", selection.relative_l2, "1"),
        Diagnostic("residual_degree", float(selection.degree), "1"),
        Diagnostic("diffraction_share", selection.share, "1"),
    )


def _position_sigma(shots: Shots, selection: Selection) -> float:
    """Noise limit of a centroid: the image's width over its signal-to-noise ratio, in the mean over shots."""
    offsets = shots.offsets()[None] + shots.origin_px[:, None, None] - selection.sources.place_px[:, None, None]
    near = (np.abs(offsets) <= 2.5).all(axis=-1)
    signal = np.maximum(shots.rate, 0.0) * near
    width2 = (signal[..., None] * offsets**2).sum(axis=(1, 2, 3)) / np.maximum(2 * signal.sum(axis=(1, 2)), 1e-30)
    information = (shots.rate**2 * shots.weight * near).sum(axis=(1, 2))
    return float(np.sqrt(np.mean(width2 / np.maximum(information, 1e-30))))
