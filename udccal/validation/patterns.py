"""Patterns in the errors of a prediction: errors that neighbours share, which noise does not.

Errors are gathered in groups, and the groups' means are tested against chance. A check of a pattern has its size in
addition to chance: it is 0 unless a grouping shows more than chance does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.engine.misfit import NO_TEST, MisfitTest, chi2_test, f_test, sharper
from udccal.sessions.schema import TermName
from udccal.validation.checks import Check, at_most

# Smaller probabilities are not told: they depend on the last details of the noise.
_LEAST_P = 1e-12


@final
@dataclass(frozen=True)
class Pattern:
    """Whether groups differ by more than chance, and the square of their RMS difference beyond it.

    ``square`` is in the unit of the errors; by chance it is as often below 0 as above.
    """

    test: MisfitTest
    square: float

    @classmethod
    def by_scatter(cls, between: float, total: float, rank: int, dof: int, weight: float) -> Pattern:
        """By an F-test, for errors whose noise is known from their scatter alone.

        Args:
            between: part of the sum of squares that the pattern explains, with ``rank`` degrees of freedom.
            total: sum of squares, with ``dof`` degrees of freedom, those of ``rank`` included.
            weight: sum of the weights of the squares: their number where all count alike.
        """
        within = max(total - between, 1e-300) / max(dof - rank, 1)
        test = f_test(between * dof / max(total, 1e-300), rank, float(dof))
        return cls(test, (between - rank * within) / max(weight, 1e-300))


@final
@dataclass(frozen=True)
class Samples:
    """Errors that are known up to noise, and up to a model error that the profile states.

    Attributes:
        error: seen less predicted, in any unit.
        noise: variance of each by noise, in the square of that unit.
        model: standard deviation of each by the model error, whose sign is not known.
        shared: number of each sample's model error; samples of one group with the same number have the same sign.
    """

    error: Float[np.ndarray, " n"]
    noise: Float[np.ndarray, " n"]
    model: Float[np.ndarray, " n"]
    shared: Int[np.ndarray, " n"]

    def pattern(self, group: Int[np.ndarray, " n"]) -> Pattern:
        """Test means of groups, in units of sigma: dim samples count as much as bright ones.

        For its size, a pattern is taken to change from sample to sample as their sigma does.
        """
        sigma = np.sqrt(self.noise + self.model**2)
        count = np.bincount(group)
        seen = count > 0
        mean, by_noise, area = (
            np.bincount(group, part)[seen] / count[seen]
            for part in (self.error / sigma, self.noise / sigma**2, sigma**2)
        )
        # Model errors of one number add up, and their sums scatter.
        pairs, pair = np.unique(np.stack([group, self.shared]), axis=1, return_inverse=True)
        sums = np.bincount(pair.reshape(-1), self.model / sigma)
        by_model = np.bincount(pairs[0], sums**2, len(count))[seen] / count[seen]
        variance = (by_noise + by_model) / count[seen]
        test = chi2_test(float(np.sum(mean**2 / variance)), float(seen.sum()))
        return Pattern(test, float(np.average((mean**2 - variance) * area, weights=count[seen])))


def scatter_pattern(error: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"]) -> Pattern:
    """Test means of groups by the scatter within them, for errors of equal but unknown noise about a common mean."""
    count = np.bincount(group)
    seen = count > 0
    about = error - error.mean()
    means = np.bincount(group, about)[seen] / count[seen]
    between, total = float(np.sum(count[seen] * means**2)), float(about @ about)
    return Pattern.by_scatter(between, total, int(seen.sum()) - 1, len(error) - 1, float(len(error)))


def bands(size: int, most: int) -> Int[np.ndarray, " size"]:
    """Number of the band of each row or column, of ``most`` bands at most."""
    return np.arange(size) * min(most, size) // size


def pattern_check(
    term: TermName, name: str, patterns: Sequence[Pattern], scale: float, limit: float, unit: str, data: str
) -> Check:
    """Return the check of the largest pattern that chance does not explain.

    Args:
        patterns: of the same errors, in different groups.
        scale: ``unit`` over the unit of the errors.
        data: what was predicted, for the sentence.
    """
    # As many tests as there are groupings find a pattern by chance as often as one test does.
    tests = [sharper(one.test, *[NO_TEST] * (len(patterns) - 1)) for one in patterns]
    sizes = [max(one.square, 0.0) for one, test in zip(patterns, tests, strict=True) if test.found]
    value = scale * float(np.sqrt(max(sizes, default=0.0)))
    p_value = min(test.p_value for test in tests)
    chance = f"p = {p_value:.2g}" if p_value > _LEAST_P else f"p < {_LEAST_P:.0g}"
    seen = f"a pattern of {value:.3g} {unit} (RMS, {chance})" if sizes else f"no pattern ({chance})"
    return at_most(term, name, value, limit, unit, f"{data} have {seen}.")
