"""The psf fit's result: estimates with sigma, the sigma of the whole kernel, its held-out error, and notes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from udccal.fitting.engine.gaussian import Posterior, square_root
from udccal.fitting.engine.misfit import SIGNIFICANT
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.psf.data import HUBER, PsfData, PsfRules
from udccal.fitting.psf.diffraction import DiffractionFit, efficiency, kernel_sigma
from udccal.fitting.psf.held_out import KernelError, Support
from udccal.fitting.psf.kernel import BLUR
from udccal.fitting.psf.orders import Selection
from udccal.fitting.psf.samples import Lights, Samples
from udccal.kernels import kernel_size, kernels_at
from udccal.models.diffraction import Diffraction
from udccal.models.fields import polynomial_basis
from udccal.models.psf import PsfField
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus
from udccal.rig import RigDescription

# The first parameters: name, unit, and true for a length on the panel, which is measured in pitches.
_NUMBERS: Final = (
    ("pitch_mm", "mm", True),
    ("column_open", "1", False),
    ("row_open", "1", False),
    ("depth_mm", "mm", True),
    ("pupil_diameter_mm", "mm", True),
    ("blur_px", "px", False),
)


def report(
    data: PsfData, fit: DiffractionFit, selection: Selection, term: PsfField, rig: RigDescription, rules: PsfRules
) -> FitResult[PsfField]:
    """Put the result together; the support of the ``selection`` is the final one, by crops or by whole pictures."""
    diffracts, samples = not selection.trial.order.free, fit.problem.samples
    worst = float(np.sqrt((selection.held_out**2).mean()))
    status = FitStatus.CONVERGED
    if not np.isfinite(worst) or worst > rules.poor:
        status = FitStatus.POOR_FIT
    elif diffracts and not fit.converged:
        status = FitStatus.NOT_CONVERGED
    cov, tolerance = fit.cov(), rig.panel.pitch_mm.tolerance / rig.panel.pitch_mm.value
    numbers, cov_of_numbers = _estimates(fit, selection, cov, tolerance)
    errors, held_out = fit.errors(), selection.trial.compared.errors()
    used, pattern_p = np.asarray(samples.weight) > 0, pattern_p_value(samples, errors)
    places = fit.shots.centre_px[np.broadcast_to(np.asarray(samples.index)[..., None], used.shape)[used]]
    return FitResult(
        name="psf",
        term=term,
        status=status,
        estimates=numbers,
        cov=cov_of_numbers,
        chi2_dof=fit.chi2_dof if diffracts else float(np.mean(held_out**2)),
        samples=fit.problem.used if diffracts else len(held_out),
        candidates=(*(fit.phase.candidates if fit.phase else ()), *selection.candidates, *selection.support.candidates),
        diagnostics=_diagnostics(data, fit, selection, pattern_p, rules),
        notes=_notes(data, selection, term, pattern_p),
        outliers=fit.outliers,
        residuals=residual_sample(places, errors[used]) if diffracts else None,
        posterior=_posterior(fit, selection, term, rig, cov, tolerance),
    )


def _estimates(
    fit: DiffractionFit, selection: Selection, whole: Float[np.ndarray, "p p"], pitch_tolerance: float
) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "n n"]]:
    held_out, count = selection.held_out, len(_NUMBERS)
    error, spread = float(held_out.mean()), float(held_out.std(ddof=1) / np.sqrt(held_out.size))
    if selection.trial.order.free:
        return (Estimate("kernel_relative_l2", error, spread, "1"),), np.array([[spread**2]])
    kernel = Estimate("kernel_relative_l2", error, float(np.hypot(kernel_sigma(fit, whole), spread)), "1")
    names, units, lengths = zip(*_NUMBERS, strict=True)
    # The fit's own parameter is the logarithm of the blur.
    values, unit = fit.theta[:count].copy(), np.ones(count)
    values[BLUR] = unit[BLUR] = np.exp(fit.theta[BLUR])
    by_pitch = np.where(lengths, values, 0.0) * pitch_tolerance
    cov = whole[:count, :count] * np.outer(unit, unit) + np.outer(by_pitch, by_pitch)
    return (*estimates(names, units, values, cov), kernel), cov


def _posterior(
    fit: DiffractionFit,
    selection: Selection,
    term: PsfField,
    rig: RigDescription,
    cov: Float[np.ndarray, "p p"],
    pitch_tolerance: float,
) -> Posterior[PsfField]:
    """Return the posterior of the parameters of diffraction, of the pitch, and of the kernel's error without noise.

    All lengths and wavelengths are measured in pitches: the pitch's tolerance scales them together, which does not
    change the kernel. Positions held out show the kernel's error. It becomes a residual on every pixel of a kernel,
    whose size follows the kernel there, with the signs of sixteen drawn patterns.
    """
    error, count, evaluator = selection.error, fit.theta.size, fit.problem.evaluator
    patterns = 16 if error.size else 0
    factor = np.zeros((count + 1 + patterns, count + 1 + patterns))
    if not selection.trial.order.free:
        factor[:count, :count] = square_root(cov)
        factor[count, count] = pitch_tolerance
    factor[count + 1 :, count + 1 :] = np.eye(patterns) / np.sqrt(max(patterns, 1))
    # A result lives long and the data are large: the function below keeps only what it needs.
    size_and_signs = cache(lambda: _error_patterns(term, error, rig, patterns))

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


def _error_patterns(
    term: PsfField, error: KernelError, rig: RigDescription, patterns: int
) -> tuple[int, Float[np.ndarray, "terms 3 rows columns"], Float[np.ndarray, "patterns 3 rows columns"]]:
    """Return a degree, the size of the kernel's error as polynomials of that degree of the position, and signs.

    Four places along each axis determine cubic polynomials.
    """
    along = np.stack(np.meshgrid(*2 * (np.linspace(-0.9, 0.9, 4),)), axis=-1).reshape(-1, 2)
    places, degree = np.asarray(term.centre_px) + along * np.asarray(term.half_px), max(3, term.degree)
    rows, columns = (max(pair) for pair in zip(kernel_size(rig), term.residual.shape[2:], strict=True))
    sizes = error.of_kernels(kernels_at(term, places, rows, columns).astype(np.float64))
    basis = np.asarray(polynomial_basis(along, degree), dtype=np.float64)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (patterns, *sizes.shape[1:]))
    return degree, np.tensordot(np.linalg.pinv(basis), sizes, axes=1), signs


def as_numpy(model: Diffraction) -> Diffraction:
    """Return the model with numpy leaves."""
    return Diffraction(*(np.asarray(getattr(model, name), np.float64) for name in Diffraction.__dataclass_fields__))


def pattern_p_value(samples: Samples, z: Lights) -> float:
    """Return the probability that noise alone makes residuals of a position's pictures at least as similar.

    Each picture has its own noise, and samples the kernel at its own fraction of a pixel. Residuals of one colour at
    the same place of the kernel, within a pixel, are uncorrelated between two pictures unless the model is wrong there.
    The mean of their products, in units of its standard error, is normal. Means of groups (``engine.misfit``) also hold
    squares, which are no evidence and hide the common part of two pictures.
    ``z`` is data less expectation, in units of sigma.
    """
    z = np.clip(z, -HUBER.sigma, HUBER.sigma)
    cell = np.concatenate(
        [np.floor(np.asarray(samples.points)), np.asarray(samples.colour).argmax(axis=-1)[..., None]], axis=-1
    ).astype(np.int64)
    position = np.broadcast_to(np.arange(len(z))[:, None, None, None], (*z.shape, 1))
    number = np.unique(np.concatenate([position, cell], axis=-1).reshape(-1, 4), axis=0, return_inverse=True)[1]
    shot = np.broadcast_to(np.arange(z.shape[1])[:, None], z.shape).ravel()
    sums, squares = (np.zeros((int(number.max()) + 1, z.shape[1])) for _ in range(2))
    np.add.at(sums, (number.reshape(-1), shot), z.ravel())
    np.add.at(squares, (number.reshape(-1), shot), z.ravel() ** 2)
    # Only pairs of different pictures count.
    total, variance = (float((part.sum(axis=1) ** 2 - (part**2).sum(axis=1)).sum()) / 2.0 for part in (sums, squares))
    return float(ndtr(-total / np.sqrt(variance))) if variance > 0 else 1.0


def support_notes(term: PsfField, support: Support) -> tuple[str, ...]:
    """Return the notes for axes along which no end of the kernel's light was seen."""
    along = [name for name, on in zip(("columns", "rows"), support.open_ended, strict=True) if on]
    if not along or not term.diffraction_fraction:
        return ()
    seen = "light was seen as far as was looked; beyond, the kernel is diffraction as fitted."
    return (f"Along {' and '.join(along)} {seen}",)


def _notes(data: PsfData, selection: Selection, term: PsfField, pattern_p: float) -> tuple[str, ...]:
    if selection.trial.order.free:
        notes = [
            "The blur is not that of a panel's grating: an image carries the kernel; no number of diffraction is "
            "known.",
            "chi2_dof is of that image at positions held out, and allows for their model error.",
        ]
    else:
        notes = [
            "cov covers the numbers of diffraction; field coefficients of the residual and spectra are left out of it.",
            "chi2_dof is of the fit of diffraction and allows for the model error of its residuals.",
        ]
        if pattern_p <= SIGNIFICANT:
            percent = f"{100 * selection.relative_l2:.2g} %"
            off = f" The kernel is off by {percent} where it was not captured; sigmas include that."
            notes.append(
                f"Residuals of diffraction have a pattern (p = {pattern_p:.1g}).{off if selection.error.size else ''}"
            )
    notes += support_notes(term, selection.support)
    dark, clipped = data.dark, data.clipped
    if dark + clipped:
        notes.append(f"{dark + clipped} pictures were left out: {dark} without an LED, {clipped} clipped.")
    return tuple(notes)


def _diagnostics(
    data: PsfData, fit: DiffractionFit, selection: Selection, pattern_p: float, rules: PsfRules
) -> tuple[Diagnostic, ...]:
    shots, order = fit.shots, selection.trial.order
    everything = data.shots.within(rules.half_px) if data.shots else shots
    names = (f"held_out_l2_{name}" for name in ("red", "green", "blue"))
    numbers = dict(zip(names, selection.held_out, strict=True)) | {
        "field_positions": everything.positions,
        "pictures": everything.count,
        "samples_left_out": int((everything.weight <= 0).sum()),
        "iterations": fit.iterations,
        "kernel_error_l2": selection.relative_l2,
        "residual_degree": order.degree,
        "diffraction_fraction": not order.free,
        "model_error": fit.model_error,
        "efficiency": efficiency(fit, rules, everything.count, len(_NUMBERS)),
        "residual_pattern_p": pattern_p,
    }
    if fit.phase:
        numbers["wire_phase_strength"], numbers["wire_phase_strength_sigma"] = fit.phase.best.fit
    lengths = zip(("support_rows", "support_columns"), selection.support.half_px, strict=True)
    return (
        *(Diagnostic(name, float(value), "1") for name, value in numbers.items()),
        *(Diagnostic(name, float(value), "px") for name, value in lengths),
    )
