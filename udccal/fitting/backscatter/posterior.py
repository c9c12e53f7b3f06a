"""Means and covariance of the values over their posterior, integrated along the reflection where that is hardly known.

The likelihood is close to a parabola in the solver's coordinates but for one of them: once nearly all light comes by
way of the glass, or nearly none does, more of the same changes nothing, and the logarithm of the reflection runs away.
Along it the posterior is worked out on a ladder of values, at each of which all other parameters are normal: integrated
over by Laplace's method (Tierney and Kadane, Journal of the American Statistical Association 81, 1986).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.backscatter.likelihood import errors_of
from udccal.fitting.backscatter.select import Choice
from udccal.fitting.backscatter.vector import REFLECTION, Moments, Prior, moments_of, moments_over
from udccal.fitting.solvers import Linearised, Solution, most_probable

# A normal posterior of the reflection's logarithm that is narrower than this is taken as one: its mean is off by a
# twentieth of a sigma at most.
_NARROW = 0.1
# Rungs end where what is left weighs less than exp of this.
_NOTHING_LEFT = -6.0
_MOST_RUNGS = 12


@dataclass(frozen=True)
class _Rung:
    """The other parameters at one value of the reflection, and the posterior's logarithm there."""

    x: Float[np.ndarray, "18"]
    cov: Float[np.ndarray, "18 18"]
    log: float


def stated(choice: Choice, inflation: float) -> Moments:
    """Of the chosen candidate; where others may be right, the covariance holds them, too.

    Their part is their own covariance and by how much they differ from the chosen one, by their probability (Hoeting et
    al., Statistical Science 14, 1999). ``inflation`` is of the noise's variance, where residuals hang together.
    """
    own = _of_chosen(choice, inflation)
    cov = np.zeros_like(own.cov)
    for one, probability in zip(choice.rivals, choice.odds, strict=True):
        part = own if one.order is choice.order else moments_of(one.solution.x, one.solution.cov)
        off = part.mean - own.mean
        cov += probability * (part.cov + np.outer(off, off))
    return Moments(own.mean, cov)


def _of_chosen(choice: Choice, inflation: float) -> Moments:
    problem, fitted, free = choice.problem, choice.state.fitted, choice.order.free > 0
    weight = fitted.weight / np.sqrt(inflation)
    errors_at, solution = errors_of(problem.template, problem.seen, weight, fitted.corner), fitted.solution
    if inflation > 1:
        # The prior is as sure as before: only the pictures say less.
        solution = most_probable(errors_at, solution.x, free, problem.prior.mean, problem.prior.sigma)
    return posterior_moments(errors_at, solution, free, problem.prior)


def posterior_moments(errors_at: Linearised, solution: Solution, free: Bool[np.ndarray, "18"], prior: Prior) -> Moments:
    """Mean and covariance of the values around the most probable parameters.

    Args:
        errors_at: whitened errors and slopes, as the solution was found with.
        solution: the most probable parameters.
        free: parameters that were fitted.
        prior: in the solver's coordinates.
    """
    step = float(np.sqrt(max(solution.cov[REFLECTION, REFLECTION], 0.0)))
    if not free[REFLECTION] or step < _NARROW or not solution.converged:
        return moments_of(solution.x, solution.cov)
    ladder = _Ladder(errors_at, free & (np.arange(len(free)) != REFLECTION), prior, solution, step)
    rungs = ladder.rungs()
    # Equal steps: sums over rungs are integrals, to many digits for what falls off this smoothly.
    logs = np.array([one.log for one in rungs])
    weights = np.exp(logs - logs.max())
    return moments_over([moments_of(one.x, one.cov) for one in rungs], weights / weights.sum())


@dataclass(frozen=True)
class _Ladder:
    """Conditional fits at equal steps of the reflection's logarithm, as long as the posterior is not nothing there."""

    errors_at: Linearised
    others: Bool[np.ndarray, "18"]
    prior: Prior
    solution: Solution
    step: float

    def rungs(self) -> list[_Rung]:
        """From the most probable value outwards, both ways."""
        along = self.solution.cov[:, REFLECTION] / self.step
        middle = self._at(self.solution.x)
        return [middle, *self._outwards(middle, along), *self._outwards(middle, -along)]

    def _outwards(self, middle: _Rung, way: Float[np.ndarray, "18"]) -> list[_Rung]:
        """``way`` is the change of all parameters along the first step."""
        found, last = [], middle
        for _ in range(_MOST_RUNGS):
            rung = self._at(last.x + way)
            found.append(rung)
            way, last = rung.x - last.x, rung
            # In squares of the value, to which its variance goes, rungs upwards weigh more.
            ahead = 2 * max(float(rung.x[REFLECTION] - middle.x[REFLECTION]), 0.0)
            if not rung.log - middle.log + ahead > _NOTHING_LEFT:
                break
        return found

    def _at(self, start: Float[np.ndarray, "18"]) -> _Rung:
        prior, others = self.prior, self.others
        held = most_probable(self.errors_at, start, others, prior.mean, prior.sigma)
        off = float((start[REFLECTION] - prior.mean[REFLECTION]) / prior.sigma[REFLECTION])
        narrowed = held.cov[np.ix_(others, others)] / np.outer(prior.sigma[others], prior.sigma[others])
        log = 0.5 * (float(np.linalg.slogdet(narrowed)[1]) - held.chi2 - off**2)
        return _Rung(held.x, held.cov, log)
