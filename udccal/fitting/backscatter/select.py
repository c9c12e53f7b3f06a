"""Which order of the backscatter model the pictures ask for, with odd shots and samples left out on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.backscatter.begin import Problem, calmed, solved, two_planes
from udccal.fitting.backscatter.checks import (
    lost_bins,
    odd_pictures,
    odd_samples,
    undescribed_share,
)
from udccal.fitting.backscatter.evidence import weights, weights_to_start
from udccal.fitting.backscatter.held_out import HeldOut, held_out
from udccal.fitting.backscatter.likelihood import Fitted, degrees_of_freedom, reweighed
from udccal.fitting.backscatter.solve import with_room
from udccal.fitting.backscatter.vector import (
    CROSSTALK,
    KERNELS,
    ONE_PLANE,
    TWO_PLANES,
    Order,
    Prior,
    values_of,
    without_crosstalk,
)
from udccal.fitting.solvers import Solution

_ROUNDS = 4
# Model's error, as a share of white, from which no order describes anything and none is compared.
_NOTHING_FITS = 0.05
# Rise of chi2 from which a candidate is not fitted any more.
_HOPELESS = 1000.0


@dataclass(frozen=True)
class State:
    """A fit on its way: what is used of the samples, and what the model leaves undescribed of a ratio."""

    fitted: Fitted
    usable: Bool[np.ndarray, "shots 3 n"]
    share: float


@dataclass(frozen=True)
class Rival:
    """A candidate's fit at the weights that all candidates share, and its criterion."""

    order: Order
    solution: Solution
    criterion: float


@dataclass(frozen=True)
class Choice:
    """The order that was chosen and its fit.

    ``rivals`` holds all candidates, the chosen one included. ``odd_shots`` are left out whole (white first).
    """

    problem: Problem
    order: Order
    state: State
    rivals: tuple[Rival, ...]
    odd_shots: Bool[np.ndarray, " shots"]
    held_out: HeldOut

    @property
    def freedom(self) -> float:
        """Degrees of freedom; a parameter that its prior holds takes less than one."""
        return freedom_of(self.state.fitted, self.order, self.problem.prior)

    @property
    def odds(self) -> Float[np.ndarray, " rivals"]:
        """How probable each candidate is."""
        criteria = np.array([one.criterion for one in self.rivals])
        odds = np.exp(-0.5 * (criteria - criteria.min()))
        return np.asarray(odds / odds.sum())


def choose(problem: Problem, kernels: tuple[Order, ...] = KERNELS) -> Choice:
    """Fit the candidates and take the one of the largest evidence; ``kernels`` holds one where the order is known."""
    seen = problem.seen
    usable = seen.usable
    noise = weights_to_start(seen)
    first = replace(calmed(problem, ONE_PLANE, problem.start, noise), weight=noise)
    odd = odd_pictures(first)
    problem = replace(problem, template=with_room(problem.template, first.solution.x, seen.rays))
    rich = two_planes(problem, first, np.where(odd[:, None, None], 0.0, noise))
    # Judged anew: one plane describes some good pictures badly.
    odd = odd_pictures(replace(rich, weight=noise))
    rich = replace(rich, weight=np.where(odd[:, None, None], 0.0, noise))
    state = State(rich, _without_odd(problem, rich, usable & ~odd[:, None, None], usable), 0.0)
    state = refit(problem, TWO_PLANES, state)
    problem = replace(problem, template=with_room(problem.template, state.fitted.solution.x, seen.rays))
    if state.share > _NOTHING_FITS:
        kernels = (TWO_PLANES,)
    order, start, rivals = _compared(problem, state, first.solution.x, kernels)
    chosen = solved(problem, order, start, state.fitted.weight)
    state = refit(problem, order, replace(state, fitted=chosen))
    held = held_out(problem, order, state.fitted)
    # Pictures that took no part tell what new ones will meet.
    return Choice(problem, order, replace(state, share=max(state.share, held.share)), rivals, odd, held)


def refit(problem: Problem, order: Order, state: State) -> State:
    """With weights of the model, and with what the model leaves undescribed at its size, until both stay."""
    for _ in range(2):
        fitted, share = state.fitted, state.share
        freedom = freedom_of(fitted, order, problem.prior)
        share = undescribed_share(fitted, problem.seen, freedom)
        weight = weights(problem.seen, fitted.mask * fitted.ratio, fitted.mask, share, state.usable)
        state = State(solved(problem, order, fitted.solution.x, weight), state.usable, share)
    return state


def freedom_of(fitted: Fitted, order: Order, prior: Prior) -> float:
    """Degrees of freedom of chi2 without the prior's part."""
    known = np.where(order.free > 0, np.diag(fitted.solution.cov) / prior.sigma**2, 1.0)
    return degrees_of_freedom(fitted.weight, float(np.maximum(1.0 - known, 0.0).sum()))


def _without_odd(
    problem: Problem, fitted: Fitted, usable: Bool[np.ndarray, "shots 3 n"], before: Bool[np.ndarray, "shots 3 n"]
) -> Bool[np.ndarray, "shots 3 n"]:
    """Samples that stay: the worst of a bin goes, and the bin's mask is worked out anew, until none is odd."""
    begun = usable
    for _ in range(_ROUNDS):
        weight = np.where(usable, fitted.weight, 0.0)
        fitted = reweighed(fitted.solution, fitted.corner, fitted.ratio, problem.seen, weight)
        odd = odd_samples(fitted)
        if not odd.any():
            break
        usable = usable & ~odd
    return usable & ~lost_bins(usable, begun)


def _compared(
    problem: Problem, state: State, simple: Float[np.ndarray, "18"], kernels: tuple[Order, ...]
) -> tuple[Order, Float[np.ndarray, "18"], tuple[Rival, ...]]:
    """All orders at the same weights: the chosen one, where to start it, and all of them."""
    rich, weight, prior = state.fitted, state.fitted.weight, problem.prior
    tried: list[Rival] = []
    for order in kernels:
        start = simple if order.free[4] == 0 else rich.solution.x
        fitted = rich if order is TWO_PLANES else solved(problem, order, start, weight)
        tried.append(Rival(order, fitted.solution, _criterion(fitted.solution, order, prior)))
    best = min(tried, key=lambda one: one.criterion)
    plain, off = without_crosstalk(best.order), _crosstalk_chi2(best.solution)
    if off > _HOPELESS:
        # A fit without it would wander far for nothing: the loss is told from the parabola at the minimum.
        tried.append(Rival(plain, best.solution, _criterion(best.solution, plain, prior) + off))
    else:
        bare = solved(problem, plain, best.solution.x, weight).solution
        tried.append(Rival(plain, bare, _criterion(bare, plain, prior)))
    best = min(tried, key=lambda one: one.criterion)
    return best.order, best.solution.x, tuple(tried)


def _crosstalk_chi2(solution: Solution) -> float:
    """By how much chi2 would rise without crosstalk, to second order (the Wald statistic)."""
    crosstalk = values_of(solution.x)[CROSSTALK]
    cov = solution.cov[CROSSTALK, CROSSTALK] * np.outer(crosstalk, crosstalk)
    return float(crosstalk @ np.linalg.pinv(cov, hermitian=True) @ crosstalk)


def _criterion(solution: Solution, order: Order, prior: Prior) -> float:
    """-2 ln of the evidence by Laplace's method: chi2, and per parameter how far the data narrow its prior.

    It is what the BIC approximates for priors as wide as one sample's information. The priors here say more than that:
    a parameter that the data cannot tell costs nothing and stays, with its true error bar. What is known about panels
    beforehand counts as well.
    """
    free = order.free > 0
    narrowed = solution.cov[np.ix_(free, free)] / np.outer(prior.sigma[free], prior.sigma[free])
    return solution.chi2 - float(np.linalg.slogdet(narrowed)[1]) + order.against
