"""Conversion of a fit's evidence to and from its stored form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from udccal.errors import ProfileError
from udccal.profiles import arrays
from udccal.profiles.schema import Numbers, StoredArray, StoredCandidate, StoredDiagnostic, StoredEstimate, StoredFit
from udccal.result import Candidate, Diagnostic, Estimate, FitResult, FitStatus


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
        estimates=tuple(
            StoredEstimate(name=e.name, value=float(e.value), sigma=float(e.sigma), unit=e.unit)
            for e in result.estimates
        ),
        candidates=tuple(
            StoredCandidate(name=c.name, parameters=c.parameters, criterion=float(c.criterion), chosen=bool(c.chosen))
            for c in result.candidates
        ),
        diagnostics=tuple(StoredDiagnostic(name=d.name, value=float(d.value), unit=d.unit) for d in result.diagnostics),
        notes=result.notes,
        covariance=_store_covariance(np.asarray(result.cov), section, folder),
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
        estimates=tuple(Estimate(e.name, e.value, e.sigma, e.unit) for e in stored.estimates),
        cov=_load_covariance(stored.covariance, folder),
        chi2_dof=stored.chi2_dof,
        samples=stored.samples,
        candidates=tuple(Candidate(c.name, c.parameters, c.criterion, c.chosen) for c in stored.candidates),
        diagnostics=tuple(Diagnostic(d.name, d.value, d.unit) for d in stored.diagnostics),
        notes=stored.notes,
    )


def _store_covariance(cov: np.ndarray, section: str, folder: Path) -> Numbers | StoredArray | None:
    if cov.size == 0:
        return None
    if arrays.fits_inline(cov):
        return arrays.inline("covariance", cov, "products of the estimates' units", None)
    return arrays.store(folder, f"{section}_covariance.exr", "covariance", cov, "products of the estimates' units")


def _load_covariance(stored: Numbers | StoredArray | None, folder: Path) -> np.ndarray:
    if stored is None:
        return np.zeros((0, 0))
    cov = arrays.from_inline(stored) if isinstance(stored, Numbers) else arrays.load(folder, stored)
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
