"""Outliers: how much they count in a fit, and by which rule they are left out.

All terms follow one contract. An ``OutlierRule`` compares residuals in units of their sigma with the residuals' own
robust scatter, so that noise larger than expected does not turn all samples into outliers. Five robust sigma leave out
one of two million normal samples.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from udccal.result import Outliers

# Scatter of a normal distribution over the median of its absolute values.
MAD_TO_SIGMA = 1.4826
_NAMED = 8


def robust_sigma(z: Float[np.ndarray, "*n"]) -> float:
    """Standard deviation about 0 by the median of the absolute values, which outliers hardly change.

    Args:
        z: residuals in any unit and shape; those that are not finite are ignored.

    Returns:
        one sigma in the unit of ``z``; 0 where no residual is finite.
    """
    seen = np.abs(z[np.isfinite(z)])
    return MAD_TO_SIGMA * float(np.median(seen)) if seen.size else 0.0


@final
@dataclass(frozen=True)
class OutlierRule:
    """Leave out samples whose residual is larger than ``sigma`` robust standard deviations.

    Attributes:
        what: name of the samples, in the plural, for the sentence that states the rule.
        sigma: limit in robust standard deviations; the module explains the default.
    """

    what: str
    sigma: float = 5.0

    def off(self, z: Float[np.ndarray, "*n"], used: Bool[np.ndarray, "*n"] | None = None) -> Bool[np.ndarray, "*n"]:
        """Which of the residuals, in units of their sigma, are too far off; the scatter is of those ``used``."""
        scatter = max(1.0, robust_sigma(z if used is None else z[used]))
        off = ~(np.abs(z) <= self.sigma * scatter)
        return np.asarray(off if used is None else off & used)

    def listed(self, places: Iterable[str]) -> tuple[Outliers, ...]:
        """The samples left out at ``places``, the first of them by name; empty where there are none."""
        return outliers(f"{self.what} further than {self.sigma:g} robust sigma from the model", places)


def outliers(rule: str, places: Iterable[str]) -> tuple[Outliers, ...]:
    """The samples that a rule, stated in words, left out at ``places``: how many, and the first; empty without any."""
    named = iter(places)
    first = tuple(islice(named, _NAMED))
    return (Outliers(rule, len(first) + sum(1 for _ in named), first),) if first else ()


@final
@dataclass(frozen=True)
class Huber:
    """Squares of residuals that grow no more than linearly beyond ``sigma`` (Huber, Ann. Math. Stat. 35, 1964)."""

    sigma: float = 3.0

    def loss(self, z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """What each residual adds to chi-squared."""
        size = np.abs(z)
        return np.asarray(np.where(size < self.sigma, size**2, 2 * self.sigma * size - self.sigma**2))


@final
@dataclass(frozen=True)
class Cauchy:
    """Squares of residuals that grow with their logarithm beyond ``sigma``: for starts that may be far off."""

    sigma: float = 2.5

    def loss(self, z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """The part of chi-squared that each residual adds."""
        return np.asarray(self.sigma**2 * np.log1p((z / self.sigma) ** 2))

    def weight(self, z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Weight of each squared residual in a step: the derivative of ``loss`` by the square."""
        return np.asarray(1 / (1 + (z / self.sigma) ** 2))
