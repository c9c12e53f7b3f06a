"""The psf fit's result: the term, its estimates with sigma, and how well it predicts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf_diffraction import DiffractionFit, Problem, fitted_model
from udccal.fitting.psf_normal import kernel_coefficients
from udccal.fitting.psf_select import Selection
from udccal.fitting.psf_shots import Shots
from udccal.fitting.psf_start import HELD
from udccal.fitting.result import Diagnostic, Estimate, FitResult, FitStatus
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.models.psf import PsfField, fine_oversample

_POOR = 0.2
_DRAWS = 6
_NAMES = ("pitch", "column_open_fraction", "row_open_fraction", "structure_thickness", "pupil_diameter", "blur")
_UNITS = ("mm", "1", "1", "mm", "mm", "px")

_DIFFRACTION_NOTES = (
    "cov covers the numbers of diffraction; field coefficients of the residual and spectra are left out of it.",
    "chi2_dof is of the fit of diffraction, which allows for a model error of 1.5 % of the peak.",
)
_FREE_NOTES = (
    "The blur is not that of a panel's grating: an image carries the kernel, no number of diffraction is known.",
    "chi2_dof is of that image, and allows for a model error of 1 % of the peak.",
)


def fit_result(
    shots: Shots,
    geometry: Geometry,
    problem: Problem,
    fit: DiffractionFit,
    selection: Selection,
    size: Float[np.ndarray, "2"],
) -> FitResult[PsfField]:
    """Everything together; ``size`` is the sensor's (half width, half height) in px, also its centre."""
    term = PsfField(
        geometry=geometry,
        diffraction=fitted_model(problem.evaluator, fit.theta),
        diffraction_share=np.float64(selection.share),
        residual=selection.image,
        centre_px=size,
        half_px=size,
        degree=max(selection.degree, 0),
        fine=fine_oversample(float(fit.theta[4]), float(np.mean(np.asarray(geometry.focal)))),
    )
    worst = float(np.sqrt((selection.held_out**2).mean()))
    status = FitStatus.CONVERGED
    if not np.isfinite(worst) or worst > _POOR:
        status = FitStatus.POOR_FIT
    elif selection.share and not fit.converged:
        status = FitStatus.NOT_CONVERGED
    estimates, cov = _estimates(problem, fit, selection)
    return FitResult(
        term=term,
        status=status,
        estimates=estimates,
        cov=cov,
        chi2_dof=fit.chi2_dof if selection.share else selection.chi2_dof,
        samples=fit.samples if selection.share else selection.samples,
        candidates=selection.candidates,
        diagnostics=_diagnostics(shots, fit, selection),
        notes=_DIFFRACTION_NOTES if selection.share else _FREE_NOTES,
    )


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
        degree=0,
        fine=fine_oversample(float(model.pupil_mm), float(np.mean(np.asarray(geometry.focal)))),
    )


def failed(start: Diffraction, geometry: Geometry, status: FitStatus, note: str) -> FitResult[PsfField]:
    """No fit: the term is the nominal diffraction."""
    return FitResult(diffraction_alone(start, geometry), status, (), np.zeros((0, 0)), 0.0, 0, notes=(note,))


def _estimates(
    problem: Problem, fit: DiffractionFit, selection: Selection
) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "n n"]]:
    scale = max(fit.chi2_dof, 1.0)
    error = float(selection.held_out.mean())
    if not selection.share:
        sigma_of_mean = float(selection.held_out.std(ddof=1) / np.sqrt(selection.held_out.size))
        return (Estimate("kernel_relative_l2", error, sigma_of_mean, "1"),), np.array([[sigma_of_mean**2]])
    kernel = Estimate("kernel_relative_l2", error, _kernel_sigma(problem, fit, scale), "1")
    cov = fit.cov[: len(_NAMES), : len(_NAMES)] * scale
    # The pitch was held, so that the spectra could move; it may be off by what the rig's description allows.
    cov[0, 0] += 1.0 / (HELD * problem.prior.root[0, 0]) ** 2
    sigma = np.sqrt(np.diag(cov))
    numbers = tuple(
        Estimate(name, float(value), float(s), unit)
        for name, value, s, unit in zip(_NAMES, fit.theta, sigma, _UNITS, strict=False)
    )
    return (*numbers, kernel), cov


def _kernel_sigma(problem: Problem, fit: DiffractionFit, scale: float) -> float:
    """Relative L2 spread of what the first position expects, for parameters drawn from their covariance."""
    rng = np.random.default_rng(3)
    values, vectors = np.linalg.eigh(fit.cov * scale)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    block, overlaps = problem.blocks[0], problem.overlaps[0]

    def light(theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, "rows columns 3"]:
        return np.asarray(kernel_coefficients(problem.evaluator, theta, block, overlaps))

    middle = light(fit.theta)
    drawn = [light(fit.theta + root @ rng.standard_normal(fit.theta.size)) - middle for _ in range(_DRAWS)]
    return float(np.sqrt(np.mean([(d**2).sum() for d in drawn]) / (middle**2).sum()))


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
        Diagnostic("iterations", float(fit.iterations), "1"),
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
