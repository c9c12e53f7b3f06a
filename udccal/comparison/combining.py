"""Measurements of the same unknowns combined: the one solver of the rig's state and of the camera's movement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from udccal.comparison.comparable import check_finite
from udccal.comparison.estimates import chi2_of
from udccal.fitting.engine.gaussian import scaled_inverse


@final
@dataclass(frozen=True)
class Combined:
    """Unknowns with one covariance; NaN where no measurement depends on one.

    Attributes:
        known: which of the unknowns any measurement depends on.
        chi2, dof: of the measurements' agreement: what is left of them, by their covariance.
    """

    values: Float[np.ndarray, " n"]
    cov: Float[np.ndarray, "n n"]
    known: Bool[np.ndarray, " n"]
    chi2: float
    dof: int


def combine(
    design: Float[np.ndarray, "m n"], values: Float[np.ndarray, " m"], cov: Float[np.ndarray, "m m"]
) -> Combined:
    """Solve ``values = design @ unknowns`` by generalised least squares.

    Args:
        design: derivatives of the measurements by the unknowns.
        values: the measurements.
        cov: their covariance.

    Raises:
        ProfileError: when numbers are too large to combine.
    """
    known = np.any(design != 0, axis=0)
    design, weight = design[:, known], scaled_inverse(cov)
    with np.errstate(over="ignore", invalid="ignore"):
        information = design.T @ weight @ design
        check_finite(information)
        found_cov = scaled_inverse(information)
        found = found_cov @ design.T @ weight @ values
        left = values - design @ found
        chi2, dof = float(left @ weight @ left), chi2_of(values, cov)[1] - chi2_of(found, found_cov)[1]
    check_finite(found, np.array(chi2))
    every, every_cov = np.full(len(known), np.nan), np.full((len(known),) * 2, np.nan)
    every[known], every_cov[np.ix_(known, known)] = found, found_cov
    return Combined(every, every_cov, known, max(chi2, 0.0), dof)
