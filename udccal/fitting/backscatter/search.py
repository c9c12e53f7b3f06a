"""The search for the backscatter's order, its outliers and its model error.

A scan over whole panel pixels gives the start for one plane of emitters, which gives the start for two planes. The
evidence compares two planes with simpler orders. The chosen order's model error is estimated from all pictures, and
from those held out of another fit. It counts as noise: (e m)^2 for the error e, which is relative to white.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Int
from scipy.special import ndtri

from udccal.fitting.backscatter.data import Binned, Profile
from udccal.fitting.backscatter.model import Usable
from udccal.fitting.backscatter.other_light import DARK, WHITE, PanelCurve, brightness_of_white, unlike_test
from udccal.fitting.backscatter.parameters import (
    DEPTH,
    DISTANCE,
    KERNELS,
    MIX,
    ONE_PLANE,
    REFLECTION,
    TWO_PLANES,
    Order,
    Vector,
    values_of,
)
from udccal.fitting.backscatter.solve import Fitted, Problem
from udccal.fitting.engine.misfit import chi2_test, excess_sigma, robust_excess_sigma
from udccal.fitting.engine.orders import Attempt, Choice, choose, evidence
from udccal.fitting.engine.robust import OutlierRule, robust_sigma

BAD_PICTURES = OutlierRule("pictures in brightness or pattern")
BAD_BINS = OutlierRule("bins")


@final
@dataclass(frozen=True)
class Found:
    """The chosen order and its fit.

    Attributes:
        model_error: one sigma of the model's deviation from the truth, as a ratio to white.
        orders: all candidates and their evidence.
        held_out: rms error of held-out pictures over their peaks, without noise.
    """

    problem: Problem
    fitted: Fitted
    model_error: float
    orders: Choice[Fitted]
    held_out: float

    @property
    def dof(self) -> float:
        """Degrees of freedom of chi-squared without the prior's part."""
        return self.fitted.dof(self.problem.prior)

    @property
    def good(self) -> Bool[np.ndarray, " shots"]:
        """Shots (white first, dark last) that are not left out whole."""
        return np.asarray((self.fitted.best.weight > 0).any(axis=(1, 2)))

    @property
    def without_dark(self) -> bool:
        """Whether the dark frame was left out, because it has other light than the rest."""
        return not self.good[DARK]

    @property
    def places(self) -> Int[np.ndarray, "n 2"]:
        """Grid columns and rows of the positions."""
        template = self.problem.template
        return np.stack(np.divmod(self.problem.flat, template.columns // template.step)[::-1], axis=1)


def search(problem: Problem, kernels: tuple[Order, ...] = KERNELS) -> Found:
    """Fit the orders and choose the one of largest evidence; ``kernels`` has one item if the order is known."""
    problem, simple, rich, error = _agreeing(problem)
    usable = rich.best.weight > 0
    kernels = kernels if error <= problem.rules.nothing_fits else (TWO_PLANES,)
    orders = _compared(problem, rich, simple.found.x, kernels)
    fitted, error = refit(problem, orders.best.fit, usable)
    held, new = held_out(problem, fitted)
    # Held-out pictures show the error to expect of new ones.
    return Found(problem, fitted, max(error, new), orders, held)


def _agreeing(problem: Problem) -> tuple[Problem, Fitted, Fitted, float]:
    """Fit one plane and two; leave the dark frame out, or scale white, where the other shots agree better then.

    Without the dark frame, pictures tell the dark level of each bin, as they differ in their light there.
    """
    simple, rich, error = _richest(problem, problem.seen.usable)
    errors, jacobian = problem.linearised(rich)
    for shot in (DARK, WHITE):
        if not unlike_test(problem, rich, errors, jacobian, shot).found:
            continue
        usable = problem.seen.usable
        usable[shot] = False
        without = _richest(problem, usable)
        if without[-1] > problem.rules.better_without * error:
            continue
        fitted = without[1]
        # A panel of another curve has other light at dark codes, and is still found without the dark frame.
        if shot == DARK and not PanelCurve.of(problem, fitted, *problem.linearised(fitted)).test.found:
            return problem, *without
        if shot == WHITE:
            # White stays in, at the pictures' brightness: it has light in bins where no picture has any.
            scaled = problem.with_white(brightness_of_white(problem, fitted.best))
            if abs(scaled.white - 1) > problem.rules.unlike_white:
                return scaled, *_richest(scaled, scaled.seen.usable)
    return problem, simple, rich, error


def _richest(problem: Problem, usable: Usable) -> tuple[Fitted, Fitted, float]:
    """Fit one plane, and from there two without outliers; return both fits and the second's model error."""
    simple = _from_afar(problem, ONE_PLANE, problem.start, usable, 0.3)
    rich = _two_planes(problem, simple, usable & ~_bad_shots(problem, simple))
    # Look for bad shots again: one plane describes some good pictures badly.
    usable = _without_outliers(problem, rich, usable & ~_bad_shots(problem, rich))
    return simple, *refit(problem, rich, usable)


def refit(problem: Problem, fitted: Fitted, usable: Usable) -> tuple[Fitted, float]:
    """Fit again with weights by the model and its model error; return the fit and that error."""
    for _ in range(2):
        error = excess_sigma(*fitted.squares(problem.seen, usable), fitted.dof(problem.prior))
        weight = problem.seen.weights(fitted.light, fitted.best.mask, error, usable)
        fitted = problem.solved(fitted.order, fitted.found.x, weight)
    return fitted, error


def _from_afar(problem: Problem, order: Order, x: Vector, usable: Usable, error: float) -> Fitted:
    """Fit with this model error of the start, of white, as noise: with noise alone, the prior would have no effect."""
    for _ in range(30):
        fitted = problem.solved(order, x, problem.seen.first_weights(usable, error))
        x, before, error = fitted.found.x, error, typical_error(fitted, problem.seen)
        if error > 0.7 * before:
            break
    return fitted


def typical_error(fitted: Fitted, seen: Binned) -> float:
    """Return a robust model error relative to white, on which bad pictures have little effect."""
    return robust_excess_sigma(*fitted.squares(seen, fitted.used))


def _two_planes(problem: Problem, simple: Fitted, usable: Usable) -> Fitted:
    """Return the best of several fits, which start with reflections brighter and fainter than the emitters."""
    prior, seen = problem.prior, problem.seen
    # Not above one plane's model error: with a much larger one, all starts would end at the prior's mean.
    error, noise = typical_error(simple, seen), seen.first_weights(usable)
    fits = []
    # If the farther plane is brighter, a fit that starts with a brighter nearer one may end at its mirror image.
    for reflection in (4.0, 1.0, 0.2):
        # The mean distance of the light stays that of one plane.
        x, depth = simple.found.x.copy(), np.exp(prior.mean[DEPTH])
        between = np.exp(x[DISTANCE]) - depth * reflection / (1 + reflection)
        x[REFLECTION], x[DEPTH] = np.log(reflection), prior.mean[DEPTH]
        x[DISTANCE] = np.log(between) if between > 0 else x[DISTANCE]
        fits.append(_from_afar(problem, TWO_PLANES, x, usable, error))
    return min(fits, key=lambda one: Profile.of(seen, one.ratio, noise).chi2 + prior.cost(one.found.x))


def _bad_shots(problem: Problem, fitted: Fitted) -> Bool[np.ndarray, "shots 1 1"]:
    """Find shots that dropped, flickered or show another picture, by brightness and by size of residuals."""
    usable = problem.seen.usable
    weight = problem.seen.first_weights(usable)[:-1]
    z, model = fitted.best.errors[:-1] * weight, fitted.light[:-1] * weight
    typical = np.ma.median(np.ma.array(np.abs(z), mask=~usable[:-1]), axis=(1, 2)).filled(0.0)
    bad = typical > problem.rules.worse_pictures * max(float(np.median(typical)), ndtri(0.75))
    # Excess brightness over the model, relative to its light, in units of noise or of all shots' scatter.
    information = np.maximum((model**2).sum(axis=(1, 2)), 1e-12)
    off = (z * model).sum(axis=(1, 2)) / information
    off -= np.median(off)
    bad |= BAD_PICTURES.off(off / np.maximum(robust_sigma(off), 1 / np.sqrt(information)))
    return np.append(bad, False)[:, None, None]


def _without_outliers(problem: Problem, fitted: Fitted, usable: Usable) -> Usable:
    """Remove the worst sample of a bin, which may have biased the others, and fit the bin's mask again."""
    for _ in range(4):
        best = Profile.of(problem.seen, fitted.ratio, problem.seen.first_weights(usable))
        size, lit = np.abs(best.z), usable.copy()
        size[-1], lit[-1] = 0.0, False
        usable = usable & ~(BAD_BINS.off(size, lit) & (size == size.max(axis=0)))
    return usable


def _compared(problem: Problem, rich: Fitted, simple: Vector, kernels: tuple[Order, ...]) -> Choice[Fitted]:
    """Compare all orders at the same weights."""
    prior, weight = problem.prior, rich.best.weight

    def attempt(fitted: Fitted, more: float = 0.0) -> Attempt[Fitted]:
        order, found, free = fitted.order, fitted.found, fitted.order.free
        criterion = evidence(found.cost + more, found.cov[np.ix_(free, free)], prior.sigma[free], order.against)
        return Attempt(order.name, order.parameters, criterion, fitted)

    tried = []
    for order in kernels:
        start = rich.found.x if order.free[REFLECTION] else simple
        tried.append(attempt(rich if order is TWO_PLANES else problem.solved(order, start, weight)))
    best = choose(tried).best.fit
    # Rise of chi-squared without crosstalk, to second order (Wald's test). If it is large, a fit without crosstalk
    # would take many steps to no purpose.
    crosstalk, plain = values_of(best.found.x)[MIX], best.order.without_crosstalk()
    cov = best.found.cov[MIX, MIX] * np.outer(crosstalk, crosstalk)
    rise = float(crosstalk @ np.linalg.pinv(cov, hermitian=True) @ crosstalk)
    if rise > 1000.0:
        return choose([*tried, attempt(replace(best, order=plain), rise)])
    return choose([*tried, attempt(problem.solved(plain, best.found.x, weight))])


def held_out(problem: Problem, full: Fitted) -> tuple[float, float]:
    """Return the errors of pictures left out of a fit: relative to their peaks, and as a model error of ratios.

    Both are without noise; the model error is 0 where it is not significant. ``full`` includes these pictures.
    """
    every, seen, weight = problem.rules.held_out, problem.seen, full.best.weight.copy()
    weight[every:-1:every] = 0.0
    used = full.used & (weight == 0)
    if not used.any():
        return 0.0, 0.0
    fitted = problem.solved(full.order, full.found.x, weight)
    by_fit = fitted.best.light_variance(fitted.ratio, problem.ratios(fitted.found.x)[1], fitted.found.cov)
    square, noise, unit = fitted.squares(seen, used)
    excess = square - noise - by_fit[used]
    peak = np.maximum(np.where(used, fitted.light, 0.0).max(axis=(1, 2), keepdims=True), 1e-12)
    of_peak = float((excess / np.broadcast_to(peak**2, used.shape)[used]).mean())
    of_white = float(excess.sum() / max(float(unit.sum()), 1e-30))
    # The rise of chi-squared by added pictures equals their chi-squared by the prediction's whole covariance.
    found = chi2_test(full.found.cost - fitted.found.cost, float(used.sum())).found
    return float(np.sqrt(max(of_peak, 0.0))), float(np.sqrt(max(of_white, 0.0)) * found)
