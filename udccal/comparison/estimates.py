"""Estimates with one covariance, and the difference of two profiles' estimates with its chi-squared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final, get_args

import numpy as np
from jaxtyping import Bool, Float

from udccal.comparison.comparable import check_finite
from udccal.result import FitResult
from udccal.sessions.schema import TermName

Name = tuple[TermName, str]
ORDER: tuple[TermName, ...] = get_args(TermName)
ANGLES = ("tilt_deg", "roll_deg", "yaw_deg")
# Eigenvalues of a correlation matrix below this part of the largest are rounding.
_LEAST = 1e-10


@final
@dataclass(frozen=True)
class Estimates:
    """Estimates of all terms in their units, and their covariance."""

    names: tuple[Name, ...]
    units: tuple[str, ...]
    values: Float[np.ndarray, " n"]
    cov: Float[np.ndarray, "n n"]


@final
@dataclass(frozen=True)
class Difference:
    """B less A for the estimates that both hold with a sigma; places are compared modulo one period, angles one turn.

    Attributes:
        values: the differences. cov: of these, the sum of both covariances.
    """

    names: tuple[Name, ...]
    units: tuple[str, ...]
    a: Float[np.ndarray, " n"]
    b: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]
    cov: Float[np.ndarray, "n n"]

    @property
    def sigma(self) -> Float[np.ndarray, " n"]:
        """One standard deviation of each value."""
        return np.sqrt(np.diag(self.cov))

    def of(self, term: TermName) -> Difference:
        """Only the estimates of a term."""
        return self.only(np.array([name[0] == term for name in self.names], dtype=bool))

    def only(self, keep: Bool[np.ndarray, " n"]) -> Difference:
        """Only the marked estimates."""
        at = np.flatnonzero(keep)
        names, units = tuple(self.names[i] for i in at), tuple(self.units[i] for i in at)
        return Difference(names, units, self.a[at], self.b[at], self.values[at], self.cov[np.ix_(at, at)])

    def chi2(self) -> tuple[float, int]:
        """Chi-squared of the values by their covariance, jointly, and its degrees of freedom."""
        return chi2_of(self.values, self.cov)


def within_half_turn(angles_deg: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return angles less the whole turns that leave them closest to 0."""
    return np.asarray(angles_deg - 360.0 * np.round(angles_deg / 360.0))


def chi2_of(values: Float[np.ndarray, " n"], cov: Float[np.ndarray, "n n"]) -> tuple[float, int]:
    """Return the chi-squared of values whose expectation is 0, and its degrees of freedom: the covariance's rank."""
    if not len(values):
        return 0.0, 0
    sigma = np.sqrt(np.diag(cov))
    size, axes = np.linalg.eigh(cov / np.outer(sigma, sigma))
    known = size > _LEAST * size.max()
    z = (axes.T @ (values / sigma))[known] / np.sqrt(size[known])
    return float(z @ z), int(known.sum())


def difference(a: Estimates, b: Estimates) -> Difference:
    """Return B less A for the estimates that both hold with a sigma.

    Raises:
        ProfileError: when numbers are too large to compare.
    """
    both = tuple(name for name in a.names if name in b.names)
    at, to = ([side.names.index(name) for name in both] for side in (a, b))
    units = tuple(a.units[i] for i in at)
    with np.errstate(over="ignore", invalid="ignore"):
        values = b.values[to] - a.values[at]
        wrapped = np.where([unit == "period" for unit in units], values - np.round(values), values)
        wrapped = np.where([unit == "deg" for unit in units], within_half_turn(values), wrapped)
        cov = a.cov[np.ix_(at, at)] + b.cov[np.ix_(to, to)]
        found = Difference(both, units, a.values[at], b.values[to], wrapped, cov)
        found = found.only(np.diag(cov) > 0)
        check_finite(np.array(found.chi2()[0]))
    return found


def not_covered(a: FitResult, b: FitResult) -> tuple[str, ...]:
    """Names of estimates of a term that no chi-squared covers: without a covariance, or in one profile only."""
    held = [{one.name for one in result.estimates[: len(result.cov)] if one.sigma > 0} for result in (a, b)]
    named = [one.name for one in (*a.numbers, *b.numbers)]
    return tuple(dict.fromkeys(name for name in named if name not in held[0] & held[1]))
