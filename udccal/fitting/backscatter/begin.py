"""First fits of the backscatter term, from far away: one plane of emitters, then a second one beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.backscatter.checks import typical_share
from udccal.fitting.backscatter.evidence import Evidence
from udccal.fitting.backscatter.likelihood import Fitted, chi2_of, reweighed, solve
from udccal.fitting.backscatter.solve import corners_of
from udccal.fitting.backscatter.vector import TWO_PLANES, Order, Prior, split_plane
from udccal.models.backscatter import Backscatter

_ROUNDS = 4
# Where a second plane may start: light of it over that of the first. Where the farther one is the brighter, a fit that
# begins with the nearer one brighter may end at its mirror image.
_REFLECTIONS = (4.0, 1.0, 0.2)
# Model's error, as a share of white, that a start is taken to have; it goes on while it shrinks by this factor.
_OF_A_START, _SETTLED = 0.3, 0.7


@dataclass(frozen=True)
class Problem:
    """What all candidates share; ``flat`` are the grid indices of the positions."""

    template: Backscatter
    seen: Evidence
    flat: Int[np.ndarray, " n"]
    prior: Prior
    start: Float[np.ndarray, "18"]


def solved(problem: Problem, order: Order, x: Float[np.ndarray, "18"], weight: np.ndarray) -> Fitted:
    """The most probable parameters of an order at given weights, from ``x`` on."""
    start = order.start(x, problem.prior)
    corner = corners_of(problem.template, start, problem.seen.rays)
    return solve(problem.template, problem.seen, weight, order, problem.prior, start, corner)


def two_planes(problem: Problem, simple: Fitted, noise: np.ndarray) -> Fitted:
    """The best of some fits, with reflections brighter and fainter than the emitters themselves to begin with."""
    starts = [split_plane(simple.solution.x, problem.prior, reflection) for reflection in _REFLECTIONS]
    # No more than one plane leaves: against much more, all starts would end at the prior's mean.
    share = typical_share(simple, problem.seen)
    found = [calmed(problem, TWO_PLANES, x, noise, share) for x in starts]
    return min(found, key=lambda one: _cost(problem, one, noise))


def _cost(problem: Problem, fitted: Fitted, weight: np.ndarray) -> float:
    """Its chi2 at other weights than it was fitted at, the prior's part included."""
    off = (fitted.solution.x - problem.prior.mean) / problem.prior.sigma
    other = reweighed(fitted.solution, fitted.corner, fitted.ratio, problem.seen, weight)
    return chi2_of(other, problem.seen) + float(off @ off)


def calmed(
    problem: Problem, order: Order, x: Float[np.ndarray, "18"], noise: np.ndarray, share: float = _OF_A_START
) -> Fitted:
    """A fit from far away: what the order does not describe yet counts as noise, so that the prior keeps its say.

    Against noise alone, errors of a poor start outweigh any prior and throw the parameters far off. ``share`` is what
    the start is taken to leave undescribed.
    """
    light = np.maximum(problem.seen.light[0] - problem.seen.exposure[0] * problem.seen.dark, 0.0)
    known = noise > 0
    for _ in range(_ROUNDS):
        variance = 1 / np.where(known, noise, 1.0) ** 2
        variance[1:] += (share * light) ** 2
        fitted = solved(problem, order, x, np.where(known, 1 / np.sqrt(variance), 0.0))
        x, before, share = fitted.solution.x, share, typical_share(fitted, problem.seen)
        if share > _SETTLED * before:
            break
    return fitted
