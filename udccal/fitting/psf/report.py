"""The psf fit's result: estimates with sigma, how sure the whole kernel is, how well it predicts, notes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Final, final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import Posterior, square_root
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.psf.data import PsfData, Shots
from udccal.fitting.psf.diffraction import DiffractionFit, efficiency, kernel_sigma
from udccal.fitting.psf.held_out import KernelError, Support
from udccal.fitting.psf.kernel import BLUR
from udccal.fitting.psf.orders import Selection
from udccal.fitting.psf.start import PsfRules
from udccal.kernels import kernel_size, kernels_at
from udccal.models.diffraction import Diffraction
from udccal.models.fields import polynomial_basis
from udccal.models.psf import PsfField
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus, ResidualSample
from udccal.rig import RigDescription

# A pattern less likely than this by chance is said.
_PATTERN_P: Final = 1e-3
# The kernel's error is drawn with so many patterns of signs; its size changes over the field with polynomials of a
# degree, which so many places along each axis tell.
_PATTERNS, _DEGREE, _PLACES = 16, 3, 4
NAMES: Final = ("pitch_mm", "column_open", "row_open", "depth_mm", "pupil_diameter_mm", "blur_px")
_UNITS: Final = ("mm", "1", "1", "mm", "mm", "px")
# Which of the numbers are lengths on the panel, told in pitches.
_LENGTHS: Final = np.array([name in ("pitch_mm", "depth_mm", "pupil_diameter_mm") for name in NAMES])
_DIFFRACTION_NOTES: Final = (
    "cov covers the numbers of diffraction; field coefficients of the residual and spectra are left out of it.",
    "chi2_dof is of the fit of diffraction and allows for the model error that its residuals tell.",
)
_FREE_NOTES: Final = (
    "The blur is not that of a panel's grating: an image carries the kernel, no number of diffraction is known.",
    "chi2_dof is of that image at positions held out, and allows for the model error that these tell.",
)


@final
@dataclass(frozen=True)
class Evidence:
    """All that a result is made of; ``support`` is the one chosen, of crops or of whole pictures."""

    shots: Shots
    data: PsfData
    rig: RigDescription
    fit: DiffractionFit
    selection: Selection
    support: Support
    pitch_tolerance: float


def report(known: Evidence, term: PsfField, rules: PsfRules) -> FitResult[PsfField]:
    """Everything together."""
    fit, selection = known.fit, known.selection
    diffracts = bool(selection.order.share)
    worst = float(np.sqrt((selection.held_out**2).mean()))
    status = FitStatus.CONVERGED
    if not np.isfinite(worst) or worst > rules.poor:
        status = FitStatus.POOR_FIT
    elif diffracts and not fit.converged:
        status = FitStatus.NOT_CONVERGED
    whole = fit.cov()
    numbers, cov = _estimates(known, whole)
    errors, pattern_p = selection.compared.errors(), fit.pattern_p()
    return FitResult(
        name="psf",
        term=term,
        status=status,
        estimates=numbers,
        cov=cov,
        chi2_dof=fit.chi2_dof if diffracts else float(np.mean(errors**2)),
        samples=fit.problem.samples if diffracts else len(errors),
        candidates=(
            *(fit.phase.choice.candidates if fit.phase else ()),
            *selection.candidates,
            *known.support.candidates,
        ),
        diagnostics=_diagnostics(known, pattern_p, efficiency(fit, rules, known.shots.count, len(NAMES))),
        notes=_notes(known, term, pattern_p),
        outliers=fit.outliers,
        residuals=_residuals(fit) if diffracts else None,
        posterior=_posterior(known, term, whole),
    )


def with_support(term: PsfField, support: Support, rig: RigDescription) -> PsfField:
    """The term with how far its kernel was seen.

    Where no end of diffraction was seen, it goes on over the whole sensor; an image ends where it ends.
    """
    ends = [not (seen and bool(term.diffraction_fraction)) for seen in support.open_ended]
    size = (rig.camera.rows, rig.camera.columns)
    down, across = (half if end else most for half, end, most in zip(support.half_px, ends, size, strict=True))
    return replace(term, support_px=np.array([across, down], dtype=np.float64))


def _estimates(
    known: Evidence, whole: Float[np.ndarray, "p p"]
) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "n n"]]:
    held_out, theta = known.selection.held_out, known.fit.theta
    error, spread = float(held_out.mean()), float(held_out.std(ddof=1) / np.sqrt(held_out.size))
    if not known.selection.order.share:
        return (Estimate("kernel_relative_l2", error, spread, "1"),), np.array([[spread**2]])
    kernel = Estimate("kernel_relative_l2", error, float(np.hypot(kernel_sigma(known.fit, whole), spread)), "1")
    # The fit's own parameter is the logarithm of the blur.
    values, unit = theta[: len(NAMES)].copy(), np.ones(len(NAMES))
    values[BLUR] = unit[BLUR] = np.exp(theta[BLUR])
    by_pitch = np.where(_LENGTHS, values, 0.0) * known.pitch_tolerance
    cov = whole[: len(NAMES), : len(NAMES)] * np.outer(unit, unit) + np.outer(by_pitch, by_pitch)
    return (*estimates(NAMES, _UNITS, values, cov), kernel), cov


def _posterior(known: Evidence, term: PsfField, whole: Float[np.ndarray, "p p"]) -> Posterior[PsfField]:
    """Of the parameters of diffraction, of the pitch, and of what the kernel is off by beside noise.

    All lengths are told in pitches, and wavelengths with them: the pitch's tolerance scales them together, which leaves
    the kernel as it is. What positions held out show the kernel to be off by is a residual on every pixel of a kernel,
    of a size that follows the kernel there, with signs of several drawn patterns.
    """
    fit, error = known.fit, known.selection.error
    count, patterns = fit.theta.size, _PATTERNS if error.size else 0
    factor = np.zeros((count + 1 + patterns, count + 1 + patterns))
    if known.selection.order.share:
        factor[:count, :count] = square_root(whole)
        factor[count, count] = known.pitch_tolerance
    factor[count + 1 :, count + 1 :] = np.eye(patterns) / np.sqrt(max(patterns, 1))
    # No more is held than is needed: a result lives long, and what was fitted is large.
    evaluator, rig = fit.problem.evaluator, known.rig
    size_and_signs = cache(lambda: _error_patterns(term, error, rig, patterns))

    def term_at(x: Float[np.ndarray, " n"]) -> PsfField:
        longer = 1.0 + x[count]
        model = as_numpy(evaluator.model(x[:count]))
        scaled = {name: getattr(model, name) * longer for name in ("pitch_mm", "depth_mm", "pupil_diameter_mm")}
        model = replace(model, wavelengths_nm=model.wavelengths_nm * longer, **scaled)
        if not patterns:
            return replace(term, diffraction=model)
        size, signs = size_and_signs()
        residual = size * np.tensordot(x[count + 1 :], signs, axes=1)
        terms, _, rows, columns = term.residual.shape
        down, across = ((n - m) // 2 for n, m in zip(residual.shape[2:], (rows, columns), strict=True))
        residual[:terms, :, down : down + rows, across : across + columns] += term.residual
        return replace(term, diffraction=model, residual=residual, degree=max(_DEGREE, term.degree))

    return Posterior(np.concatenate([fit.theta, np.zeros(1 + patterns)]), factor, term_at)


def _error_patterns(
    term: PsfField, error: KernelError, rig: RigDescription, patterns: int
) -> tuple[Float[np.ndarray, "terms 3 rows columns"], Float[np.ndarray, "patterns 3 rows columns"]]:
    """Size of the kernel's error as a residual whose pixels are polynomials of the position, and signs."""
    along = np.stack(np.meshgrid(*2 * (np.linspace(-0.9, 0.9, _PLACES),)), axis=-1).reshape(-1, 2)
    places = np.asarray(term.centre_px) + along * np.asarray(term.half_px)
    rows, columns = (max(pair) for pair in zip(kernel_size(rig), term.residual.shape[2:], strict=True))
    sizes = error.of_kernels(kernels_at(term, places, rows, columns).astype(np.float64))
    basis = np.asarray(polynomial_basis(along, max(_DEGREE, term.degree)), dtype=np.float64)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (patterns, *sizes.shape[1:]))
    return np.tensordot(np.linalg.pinv(basis), sizes, axes=1), signs


def as_numpy(model: Diffraction) -> Diffraction:
    """The model with numpy leaves."""
    return Diffraction(*(np.asarray(getattr(model, name), np.float64) for name in Diffraction.__dataclass_fields__))


def support_notes(term: PsfField, support: Support) -> tuple[str, ...]:
    """What is to be said where no end of the kernel's light was seen."""
    along = [name for name, on in zip(("columns", "rows"), support.open_ended, strict=True) if on]
    if not along or not term.diffraction_fraction:
        return ()
    seen = "light was seen as far as was looked; beyond, the kernel is diffraction as fitted."
    return (f"Along {' and '.join(along)} {seen}",)


def _notes(known: Evidence, term: PsfField, pattern_p: float) -> tuple[str, ...]:
    notes = [*_DIFFRACTION_NOTES] if known.selection.order.share else [*_FREE_NOTES]
    if known.selection.order.share and pattern_p <= _PATTERN_P:
        percent = f"{100 * known.selection.relative_l2:.2g} %"
        off = f"The kernel is off by {percent} where it was not captured; sigmas include that."
        pattern = f"Residuals of diffraction have a pattern (p = {pattern_p:.1g})."
        notes.append(f"{pattern} {off}" if known.selection.error.size else pattern)
    notes += support_notes(term, known.support)
    dark, clipped = known.data.dark, known.data.clipped
    if dark + clipped:
        notes.append(f"{dark + clipped} pictures were left out: {dark} without an LED, {clipped} clipped.")
    return tuple(notes)


def _residuals(fit: DiffractionFit) -> ResidualSample:
    """Of samples of the fit of diffraction, at the places of their LED, the model error in their sigma."""
    places, z = [], []
    for block, error in zip(fit.problem.blocks, fit.errors(), strict=True):
        shot, _ = used = np.nonzero(np.asarray(block.weight) > 0)
        places.append(fit.shots.centre_px[np.asarray(block.index)[shot]])
        z.append(error[used])
    return residual_sample(np.concatenate(places), np.concatenate(z))


def _diagnostics(known: Evidence, pattern_p: float, part: float) -> tuple[Diagnostic, ...]:
    fit, selection, shots = known.fit, known.selection, known.shots
    numbers = {
        f"held_out_l2_{name}": value for name, value in zip(("red", "green", "blue"), selection.held_out, strict=True)
    }
    numbers |= {
        "field_positions": shots.positions,
        "pictures": shots.count,
        "samples_left_out": int((shots.weight <= 0).sum()),
        "iterations": fit.iterations,
        "kernel_error_l2": selection.relative_l2,
        "residual_degree": selection.order.degree,
        "diffraction_fraction": selection.order.share,
        "model_error": fit.model_error,
        "efficiency": part,
        "residual_pattern_p": pattern_p,
    }
    if fit.phase:
        numbers |= {"wire_phase_strength": fit.phase.strength, "wire_phase_strength_sigma": fit.phase.sigma}
    rows, columns = known.support.half_px
    lengths = {
        "led_position_sigma": _position_sigma(shots, selection),
        "support_rows": rows,
        "support_columns": columns,
    }
    return (
        *(Diagnostic(name, float(value), "1") for name, value in numbers.items()),
        *(Diagnostic(name, float(value), "px") for name, value in lengths.items()),
    )


def _position_sigma(shots: Shots, selection: Selection) -> float:
    """Noise limit of a centroid: the image's width over its signal-to-noise ratio, in the mean over shots."""
    offsets = shots.offsets()[None] + shots.origin_px[:, None, None] - selection.sources.place_px[:, None, None]
    near = (np.abs(offsets) <= 2.5).all(axis=-1)
    signal = np.maximum(shots.rate, 0.0) * near
    width2 = (signal[..., None] * offsets**2).sum(axis=(1, 2, 3)) / np.maximum(2 * signal.sum(axis=(1, 2)), 1e-30)
    information = (shots.rate**2 * shots.weight * near).sum(axis=(1, 2))
    return float(np.sqrt(np.mean(width2 / np.maximum(information, 1e-30))))
