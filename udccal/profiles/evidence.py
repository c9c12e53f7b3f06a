"""Conversion of a fit's evidence to and from its stored form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from udccal.errors import ProfileError
from udccal.profiles import arrays
from udccal.profiles.schema import (
    Numbers,
    StoredArray,
    StoredCandidate,
    StoredCaptures,
    StoredDiagnostic,
    StoredEstimate,
    StoredFit,
    StoredOutliers,
    StoredPrior,
)
from udccal.quantities import quantity
from udccal.result import (
    Candidate,
    Captures,
    Diagnostic,
    Estimate,
    EstimatePrior,
    FitResult,
    FitStatus,
    Outliers,
    ResidualSample,
)

_PRODUCTS = "products of the estimates' units"
# Residuals in a file: most rows, and the largest place in px and residual in sigma.
_MOST_RESIDUALS, _FARTHEST_PX, _LARGEST_Z = 20_000, 1e5, 1e6


def store_fit(result: FitResult, section: str, folder: Path) -> StoredFit:
    """Return the stored form of a fit's evidence, without its term.

    Raises:
        ProfileError: when a number is not finite.
    """
    _check_finite(section, result)
    return StoredFit(
        status=result.status.name,
        chi2_dof=float(result.chi2_dof),
        samples=int(result.samples),
        estimates=tuple(_stored_estimate(section, one) for one in result.estimates),
        candidates=tuple(
            StoredCandidate(name=c.name, parameters=c.parameters, criterion=float(c.criterion), chosen=bool(c.chosen))
            for c in result.candidates
        ),
        diagnostics=tuple(StoredDiagnostic(name=d.name, value=float(d.value), unit=d.unit) for d in result.diagnostics),
        notes=result.notes,
        covariance=_store_array(np.asarray(result.cov), "covariance", _PRODUCTS, section, folder),
        # Of a fit whose captures are not known, which an older profile held, outliers are not known either.
        outliers=tuple(StoredOutliers(rule=o.rule, count=o.count, places=o.places) for o in result.outliers)
        if result.outliers or result.captures
        else None,
        residuals=_store_residuals(result.residuals, section, folder),
        captures=None if result.captures is None else StoredCaptures(**vars(result.captures)),
        effort=result.effort,
    )


def load_fit(name: str, stored: StoredFit, term: Any, folder: Path) -> FitResult:
    """Return the fit result of a stored section.

    Raises:
        ProfileError: when the status is unknown, or the covariance is missing, altered or not square.
    """
    if stored.status not in FitStatus.__members__:
        known = ", ".join(FitStatus.__members__)
        raise ProfileError(f"Expected one of the statuses {known}, found '{stored.status}'. Update udccal to read it.")
    status = FitStatus[stored.status]
    if status is FitStatus.ABSENT and any(note.startswith(f"The session has no {name} steps") for note in stored.notes):
        status = FitStatus.NOT_CAPTURED  # earlier versions had no status of its own for it
    return FitResult(
        name=name,
        term=term,
        status=status,
        estimates=tuple(
            Estimate(e.name, e.value, e.sigma, e.unit, None if p is None else EstimatePrior(p.value, p.sigma))
            for e in stored.estimates
            for p in (e.prior,)
        ),
        cov=_load_covariance(stored.covariance, folder),
        chi2_dof=stored.chi2_dof,
        samples=stored.samples,
        candidates=tuple(Candidate(c.name, c.parameters, c.criterion, c.chosen) for c in stored.candidates),
        diagnostics=tuple(Diagnostic(d.name, d.value, d.unit) for d in stored.diagnostics),
        notes=stored.notes,
        outliers=tuple(Outliers(o.rule, o.count, o.places) for o in stored.outliers or ()),
        residuals=_load_residuals(stored.residuals, folder),
        captures=None if stored.captures is None else Captures(**dict(stored.captures)),
        effort=stored.effort,
    )


def _stored_estimate(section: str, one: Estimate) -> StoredEstimate:
    what, prior = quantity(section, one.name).what, None
    if one.prior is not None:
        prior = StoredPrior(value=one.prior.value, sigma=one.prior.sigma, decides=one.by_prior)
    value, sigma = float(one.value), float(one.sigma)
    return StoredEstimate(name=one.name, value=value, sigma=sigma, unit=one.unit, what=what, prior=prior)


def _store_array(array: np.ndarray, name: str, unit: str, section: str, folder: Path) -> Numbers | StoredArray | None:
    if array.size == 0:
        return None
    if arrays.fits_inline(array):
        return arrays.inline(name, array, unit, None)
    return arrays.store(folder, f"{section}_{name}.exr", name, array, unit)


def _store_residuals(sample: ResidualSample | None, section: str, folder: Path) -> Numbers | StoredArray | None:
    if sample is None:
        return None
    rows = np.column_stack([sample.positions_px, np.clip(sample.z, -_LARGEST_Z, _LARGEST_Z)]).astype(np.float32)
    return _store_array(rows, "residuals", "px, px, 1", section, folder)


def _load_residuals(stored: Numbers | StoredArray | None, folder: Path) -> ResidualSample | None:
    if stored is None:
        return None
    rows = _load_array(stored, folder).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) > _MOST_RESIDUALS:
        raise ProfileError(
            f"Expected residuals as rows of x, y and z, at most {_MOST_RESIDUALS}, found shape {rows.shape}. Restore "
            "the profile from a copy."
        )
    if np.any(np.abs(rows) > [_FARTHEST_PX, _FARTHEST_PX, _LARGEST_Z]):
        raise ProfileError(
            f"Expected residuals within {_FARTHEST_PX:g} px and {_LARGEST_Z:g} sigma, found others. Restore the "
            "profile from a copy."
        )
    return ResidualSample(rows[:, :2], rows[:, 2])


def _load_array(stored: Numbers | StoredArray, folder: Path) -> np.ndarray:
    return arrays.from_inline(stored) if isinstance(stored, Numbers) else arrays.load(folder, stored)


def _load_covariance(stored: Numbers | StoredArray | None, folder: Path) -> np.ndarray:
    if stored is None:
        return np.zeros((0, 0))
    cov = _load_array(stored, folder)
    if cov.ndim != 2 or cov.shape[0] != cov.shape[1]:
        raise ProfileError(f"Expected a square covariance, found shape {cov.shape}. Restore the profile from a copy.")
    return cov


def _check_finite(section: str, result: FitResult) -> None:
    numbers = [("chi2_dof", result.chi2_dof)]
    numbers += [(e.name, e.value) for e in result.estimates]
    numbers += [(f"sigma of {e.name}", e.sigma) for e in result.estimates]
    numbers += [(d.name, d.value) for d in result.diagnostics] + [(c.name, c.criterion) for c in result.candidates]
    for name, value in numbers:
        if not np.isfinite(value):
            raise ProfileError(
                f"Expected a finite '{name}' in the {section} fit, found {value}. Do not store this fit."
            )
