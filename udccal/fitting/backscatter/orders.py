"""Backscatter fit: averages of the panel's pictures under blackout -> how the panel's light gets into the lens.

White, dark and pictures share one likelihood (``likelihood``). A scan over whole panel pixels gives the start, one
plane of emitters the next, and two planes what is compared with simpler orders by its evidence. What the chosen order
cannot describe is estimated, from all pictures and from those held out of a fit of its own, and counts as noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool
from scipy.special import ndtri

from udccal.fitting.backscatter.likelihood import PerShot, Profile, Samples
from udccal.fitting.backscatter.parameters import (
    KERNELS,
    MIX,
    ONE_PLANE,
    REFLECTION,
    TWO_PLANES,
    Order,
    Vector,
    split_plane,
    values_of,
)
from udccal.fitting.backscatter.rules import BackscatterRules
from udccal.fitting.backscatter.solve import Fitted, MostProbable, Problem, SampleErrors
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.misfit import chi2_test, excess_sigma, robust_excess_sigma
from udccal.fitting.engine.orders import Attempt, Choice, choose, evidence
from udccal.fitting.engine.robust import MAD_TO_SIGMA, OutlierRule

BAD_PICTURES = OutlierRule("pictures in brightness or pattern")
BAD_BINS = OutlierRule("bins")


@final
@dataclass(frozen=True)
class State:
    """A fit on its way: what is used of the samples, and what the model leaves undescribed of a ratio, as one sigma."""

    fitted: Fitted
    usable: Bool[np.ndarray, "shots 3 n"]
    model_error: float


@final
@dataclass(frozen=True)
class OrderFit:
    """An order's most probable parameters at the weights that all orders share."""

    order: Order
    found: MostProbable


@final
@dataclass(frozen=True)
class HeldOut:
    """How a fit without some pictures predicts those.

    Attributes:
        rms_of_peak: of measured less predicted light, as a share of each picture's peak.
        excess_of_peak: the same with what noise gives taken out, that of the other pictures included.
        model_error: what the model leaves undescribed of ratios there; 0 where not significant.
    """

    rms_of_peak: float
    excess_of_peak: float
    model_error: float


@final
@dataclass(frozen=True)
class Found:
    """The order that was chosen and its fit; ``bad_shots`` are left out whole (white first, dark last)."""

    problem: Problem
    state: State
    orders: Choice[OrderFit]
    bad_shots: Bool[np.ndarray, " shots"]
    held_out: HeldOut

    @property
    def order(self) -> Order:
        """The chosen one."""
        return self.orders.best.fit.order

    @property
    def dof(self) -> float:
        """Degrees of freedom of chi-squared without the prior's part."""
        return degrees_of_freedom(self.state.fitted, self.order, self.problem.prior)


def search(problem: Problem, kernels: tuple[Order, ...] = KERNELS) -> Found:
    """Fit the orders and take the one of the largest evidence; ``kernels`` holds one where the order is known."""
    samples, noise, rules = problem.samples, problem.samples.first_weights(), problem.rules
    simple = replace(_from_afar(problem, ONE_PLANE, problem.start, noise, rules.first_error), weight=noise)
    bad = _bad_shots(simple, rules)
    problem = problem.with_room(simple.found.x)
    rich = _two_planes(problem, simple, np.where(bad[:, None, None], 0.0, noise))
    # Judged anew: one plane describes some good pictures badly.
    bad = _bad_shots(replace(rich, weight=noise), rules)
    rich = replace(rich, weight=np.where(bad[:, None, None], 0.0, noise))
    usable = _without_outliers(rich, samples, samples.usable & ~bad[:, None, None], rules)
    state = refit(problem, TWO_PLANES, State(rich, usable, 0.0))
    problem = problem.with_room(state.fitted.found.x)
    if state.model_error > rules.nothing_fits:
        kernels = (TWO_PLANES,)
    orders = _compared(problem, state.fitted, simple.found.x, kernels)
    best = orders.best.fit
    chosen = problem.solved(best.order, best.found.x, state.fitted.weight)
    state = refit(problem, best.order, replace(state, fitted=chosen))
    held = held_out(problem, best.order, state.fitted)
    # Pictures that took no part tell what new ones will meet.
    state = replace(state, model_error=max(state.model_error, held.model_error))
    return Found(problem, state, orders, bad, held)


def refit(problem: Problem, order: Order, state: State) -> State:
    """With weights of the model, and with what the model leaves undescribed at its size, until both stay."""
    for _ in range(2):
        fitted, samples = state.fitted, problem.samples
        used = fitted.weight > 0
        unit = np.broadcast_to(fitted.mask**2, used.shape).copy()
        # White and dark have no part in the model's error.
        unit[[0, -1]] = 0.0
        noise, dof = samples.variance(fitted.light), degrees_of_freedom(fitted, order, problem.prior)
        error = excess_sigma(fitted.errors[used] ** 2, noise[used], unit[used], dof)
        weight = samples.weights(fitted.light, fitted.mask, error, state.usable)
        state = State(problem.solved(order, fitted.found.x, weight), state.usable, error)
    return state


def degrees_of_freedom(fitted: Fitted, order: Order, prior: Prior) -> float:
    """Samples less one mask per bin (the dark signal has a sample of its own) less parameters.

    A parameter that its prior holds takes less than one.
    """
    narrowed = np.where(order.free, np.diag(fitted.found.cov) / prior.sigma**2, 1.0)
    used = fitted.used
    return max(float(used.sum() - used.any(axis=0).sum() - np.maximum(1.0 - narrowed, 0.0).sum()), 1.0)


def _from_afar(problem: Problem, order: Order, x: Vector, noise: PerShot, error: float) -> Fitted:
    """A fit whose start leaves much undescribed, which counts as noise, so that the prior keeps its say.

    Against noise alone, errors of a poor start outweigh any prior and throw the parameters far off. ``error`` is the
    model error that the start is taken to have.
    """
    light, used = np.maximum(problem.samples.excess[0], 0.0), noise > 0
    for _ in range(problem.rules.first_fits):
        variance = 1 / np.where(used, noise, 1.0) ** 2
        variance[1:-1] += (error * light) ** 2
        fitted = problem.solved(order, x, np.where(used, 1 / np.sqrt(variance), 0.0))
        x, before, error = fitted.found.x, error, typical_error(fitted, problem.samples)
        if error > problem.rules.settled * before:
            break
    return fitted


def typical_error(fitted: Fitted, samples: Samples) -> float:
    """Model error, as a share of white, that half of the pictures' samples have: bad pictures have no say in it."""
    used, noise = fitted.used[1:], samples.variance(fitted.light)[1:]
    unit = np.broadcast_to(fitted.mask**2, used.shape)
    return robust_excess_sigma(fitted.errors[1:][used] ** 2, noise[used], unit[used])


def _two_planes(problem: Problem, simple: Fitted, noise: PerShot) -> Fitted:
    """The best of some fits, with reflections brighter and fainter than the emitters themselves to begin with."""
    prior, samples = problem.prior, problem.samples
    # No more than one plane leaves: against much more, all starts would end at the prior's mean.
    error = typical_error(simple, samples)
    starts = [split_plane(simple.found.x, prior, reflection) for reflection in problem.rules.reflections]
    fits = [_from_afar(problem, TWO_PLANES, x, noise, error) for x in starts]
    return min(fits, key=lambda one: one.reweighed(samples, noise).chi2 + prior.cost(one.found.x))


def _bad_shots(fitted: Fitted, rules: BackscatterRules) -> Bool[np.ndarray, " shots"]:
    """Shots that dropped, flickered or were of another picture: by brightness and by how badly they are described."""
    z, used = np.abs(fitted.z), fitted.used
    typical = np.array([np.median(z[i][used[i]]) if used[i].any() else 0.0 for i in range(len(z))])
    bad = typical > rules.worse_pictures * max(float(np.median(typical[:-1])), ndtri(0.75))
    # By how much each is brighter than modelled, as a share of its light, in units of noise or of all shots' scatter.
    model = np.where(used, fitted.light * fitted.weight, 0.0)[:-1]
    information = np.maximum((model**2).sum(axis=(1, 2)), 1e-12)
    off = (fitted.z[:-1] * model).sum(axis=(1, 2)) / information
    off -= np.median(off)
    scatter = np.maximum(MAD_TO_SIGMA * np.median(np.abs(off)), 1 / np.sqrt(information))
    bad[:-1] |= BAD_PICTURES.off(off / scatter)
    return bad


def _without_outliers(
    fitted: Fitted, samples: Samples, usable: Bool[np.ndarray, "shots 3 n"], rules: BackscatterRules
) -> Bool[np.ndarray, "shots 3 n"]:
    """Samples that stay: the worst of a bin goes, which may have pulled the others off, and its mask is fitted anew."""
    begun = usable
    for _ in range(rules.sample_rounds):
        fitted = fitted.reweighed(samples, np.where(usable, fitted.weight, 0.0))
        z = np.abs(np.where(fitted.used, fitted.z, 0.0))
        off = BAD_BINS.off(z, fitted.used) & (z == z.max(axis=0))
        if not off.any():
            break
        usable = usable & ~off
    # Of a bin that lost so many, the others are not trusted either.
    lost = (begun & ~usable)[:-1].sum(axis=0) > rules.lost_bin * np.maximum(begun[:-1].sum(axis=0), 1)
    return np.concatenate([usable[:-1] & ~lost, usable[-1:]])


def _compared(problem: Problem, rich: Fitted, simple: Vector, kernels: tuple[Order, ...]) -> Choice[OrderFit]:
    """All orders at the same weights."""
    prior = problem.prior

    def attempt(order: Order, found: MostProbable, more: float = 0.0) -> Attempt[OrderFit]:
        free, cost = order.free, found.cost + more
        criterion = evidence(cost, found.cov[np.ix_(free, free)], prior.sigma[free], order.against)
        return Attempt(order.name, order.parameters, criterion, OrderFit(order, found))

    tried = []
    for order in kernels:
        start = rich.found.x if order.free[REFLECTION] else simple
        found = rich.found if order is TWO_PLANES else problem.solved(order, start, rich.weight).found
        tried.append(attempt(order, found))
    best = choose(tried).best.fit
    # By how much chi-squared would rise without crosstalk, to second order (Wald). Where that is a lot, a fit without
    # it would wander far for nothing.
    crosstalk = values_of(best.found.x)[MIX]
    cov = best.found.cov[MIX, MIX] * np.outer(crosstalk, crosstalk)
    rise = float(crosstalk @ np.linalg.pinv(cov, hermitian=True) @ crosstalk)
    plain, hopeless = best.order.without_crosstalk(), rise > problem.rules.hopeless
    bare = best.found if hopeless else problem.solved(plain, best.found.x, rich.weight).found
    return choose([*tried, attempt(plain, bare, rise if hopeless else 0.0)])


def held_out(problem: Problem, order: Order, full: Fitted) -> HeldOut:
    """A fit without some pictures, and its errors there; ``full`` is the fit with them."""
    every, samples = problem.rules.held_out, problem.samples
    weight = full.weight.copy()
    weight[every:-1:every] = 0.0
    fitted = problem.solved(order, full.found.x, weight)
    used = full.used & (weight == 0)
    if not used.any():
        return HeldOut(0.0, 0.0, 0.0)
    errors_at = SampleErrors.of(problem.template, samples, weight, fitted.corner)
    ratio, of_ratio = errors_at.ratios(fitted.found.x)
    predicted = Profile.of(ratio, samples, weight).light_variance(ratio, of_ratio, fitted.found.cov)
    square, noise = fitted.errors**2, samples.variance(fitted.light) + predicted
    peak = np.maximum(np.where(used, fitted.light, 0.0).max(axis=(1, 2), keepdims=True), 1e-12)
    relative, excess = ((part / peak**2)[used].mean() for part in (square, square - noise))
    # By how much pictures that come in raise chi-squared is their own chi-squared by the prediction's whole covariance.
    found = chi2_test(full.found.cost - fitted.found.cost, float(used.sum())).found
    unit = np.broadcast_to(fitted.mask**2, used.shape)[used]
    over = float((square - noise)[used].sum() / max(unit.sum(), 1e-30))
    return HeldOut(float(np.sqrt(relative)), float(np.sqrt(max(excess, 0.0))), float(np.sqrt(max(over, 0.0)) * found))
