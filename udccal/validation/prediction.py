"""Errors of predicted data, with what the profile's own errors and freely solved parameters do to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from udccal.comparison.estimates import chi2_of
from udccal.fitting.engine.misfit import MisfitTest, chi2_test

# Part of a group's variance below which it is an error of rounding.
_LEAST = 1e-9


@final
@dataclass(frozen=True)
class Prediction:
    """Errors of data that a profile predicts.

    Attributes:
        z: data less prediction in units of the data's sigma, at the best of the parameters that belong to the capture.
        own: orthonormal directions of ``z`` that these parameters have removed.
        by_profile: change of ``z`` by one sigma along each direction of the profile's covariance.
    """

    z: Float[np.ndarray, " n"]
    own: Float[np.ndarray, "n m"]
    by_profile: Float[np.ndarray, "n k"]

    @property
    def dof(self) -> int:
        """Degrees of freedom."""
        return len(self.z) - self.own.shape[1]

    @property
    def chi2(self) -> float:
        """Chi-squared by the data's noise and the profile's covariance together (Woodbury's identity)."""
        seen = self._by_profile()
        along = seen.T @ self.z
        inner = np.eye(len(along)) + seen.T @ seen
        return float(self.z @ self.z - along @ np.linalg.solve(inner, along))

    def pattern(self, group: Int[np.ndarray, " n"]) -> tuple[MisfitTest, float]:
        """Test sums over groups by their covariance.

        Returns:
            the test, and the RMS of the pattern in units of sigma; 0 where chance explains it.
        """
        inside = np.equal.outer(np.unique(group), group).astype(np.float64)
        count, sums = inside.sum(axis=1), inside @ self.z
        removed, moved = inside @ self.own, inside @ self._by_profile()
        cov = np.diag(count) - removed @ removed.T + moved @ moved.T
        # A group of which parameters of the capture have removed all tells nothing.
        told = np.diag(cov) > _LEAST * count
        statistic, dof = chi2_of(sums[told], cov[np.ix_(told, told)])
        test = chi2_test(statistic, float(dof))
        excess = float(((sums**2 - np.diag(cov)) / count)[told].sum() / count.sum())
        return test, float(np.sqrt(max(excess, 0.0))) if test.found else 0.0

    def _by_profile(self) -> Float[np.ndarray, "n k"]:
        return np.asarray(self.by_profile - self.own @ (self.own.T @ self.by_profile))
