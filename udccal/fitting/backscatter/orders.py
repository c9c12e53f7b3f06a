"""The search for the backscatter's order, its most probable parameters, and their covariance.

White, dark and pictures have one likelihood (``solve``). A scan over whole panel pixels gives the start for one plane
of emitters, which gives the start for two planes. The evidence compares two planes with simpler orders. The chosen
order's model error is estimated from all pictures, and from those held out of another fit. It counts as noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import ndtri

from udccal.fitting.backscatter.data import Binned
from udccal.fitting.backscatter.model import PerShot, Usable
from udccal.fitting.backscatter.parameters import (
    KERNELS,
    MIX,
    ONE_PLANE,
    REFLECTION,
    TWO_PLANES,
    BackscatterRules,
    Moments,
    Order,
    Vector,
    split_plane,
    values_of,
)
from udccal.fitting.backscatter.solve import ErrorsAt, Fitted, MostProbable, Problem, Profile, most_probable
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.misfit import (
    NO_TEST,
    MisfitTest,
    chi2_test,
    excess_sigma,
    group_means_test,
    robust_excess_sigma,
    sharper,
)
from udccal.fitting.engine.orders import Attempt, Choice, choose, evidence
from udccal.fitting.engine.robust import MAD_TO_SIGMA, OutlierRule

BAD_PICTURES = OutlierRule("pictures in brightness or pattern")
BAD_BINS = OutlierRule("bins")


@final
@dataclass(frozen=True)
class Found:
    """The chosen order and its fit.

    Attributes:
        usable: samples that are neither clipped nor outliers.
        model_error: one sigma of the model's deviation from the truth, as a ratio to white.
        orders: all candidates and their evidence.
        bad_shots: True for shots that are left out whole (white first, dark last).
        held_out: rms error of held-out pictures over their peaks, without noise.
    """

    problem: Problem
    fitted: Fitted
    usable: Usable
    model_error: float
    orders: Choice[Fitted]
    bad_shots: Bool[np.ndarray, " shots"]
    held_out: float

    @property
    def dof(self) -> float:
        """Degrees of freedom of chi-squared without the prior's part."""
        return self.fitted.dof(self.problem.prior)

    @property
    def places(self) -> Float[np.ndarray, "n 2"]:
        """Grid columns and rows of the positions."""
        template = self.problem.template
        rows, columns = np.divmod(self.problem.flat, template.columns // template.step)
        return np.stack([columns, rows], axis=1).astype(np.float64)


def search(problem: Problem, kernels: tuple[Order, ...] = KERNELS) -> Found:
    """Fit the orders and choose the one of largest evidence; ``kernels`` has one item if the order is known."""
    noise, rules = problem.seen.first_weights(), problem.rules
    simple = _from_afar(problem, ONE_PLANE, problem.start, noise, rules.first_error)
    bad = _bad_shots(simple.weighed(noise), rules)
    rich = _two_planes(problem, simple, np.where(bad[:, None, None], 0.0, noise))
    # Evaluate again: one plane describes some good pictures badly.
    bad = _bad_shots(rich.weighed(noise), rules)
    rich = rich.weighed(np.where(bad[:, None, None], 0.0, noise))
    usable = _without_outliers(problem, rich, ~bad)
    rich, error = refit(problem, rich, usable)
    orders = _compared(problem, rich, simple.found.x, kernels if error <= rules.nothing_fits else (TWO_PLANES,))
    best = orders.best.fit
    best = problem.solved(best.order, best.found.x, rich.best.weight)
    fitted, error = refit(problem, best, usable)
    held, new = held_out(problem, fitted)
    # Held-out pictures show the error to expect of new ones.
    return Found(problem, fitted, usable, max(error, new), orders, bad, held)


def refit(problem: Problem, fitted: Fitted, usable: Usable) -> tuple[Fitted, float]:
    """Fit again with weights by the model and its model error; return the fit and that error."""
    error = 0.0
    for _ in range(2):
        used, mask = fitted.best.weight > 0, fitted.best.mask
        unit = np.broadcast_to(mask**2, used.shape).copy()
        # White and dark have no model error.
        unit[[0, -1]] = 0.0
        noise = problem.seen.variance(fitted.light)
        error = excess_sigma(fitted.best.errors[used] ** 2, noise[used], unit[used], fitted.dof(problem.prior))
        weight = problem.seen.weights(fitted.light, mask, error, usable)
        fitted = problem.solved(fitted.order, fitted.found.x, weight)
    return fitted, error


def _from_afar(problem: Problem, order: Order, x: Vector, noise: PerShot, error: float) -> Fitted:
    """Fit with this model error of the start as noise: with noise alone, the prior would have no effect."""
    light, used = np.maximum(problem.seen.excess[0], 0.0), noise > 0
    for _ in range(30):
        variance = 1 / np.where(used, noise, 1.0) ** 2
        variance[1:-1] += (error * light) ** 2
        fitted = problem.solved(order, x, np.where(used, 1 / np.sqrt(variance), 0.0))
        x, before, error = fitted.found.x, error, typical_error(fitted, problem.seen)
        if error > problem.rules.settled * before:
            break
    return fitted


def typical_error(fitted: Fitted, seen: Binned) -> float:
    """Return a robust model error relative to white, on which bad pictures have little effect."""
    used, noise = fitted.used, seen.variance(fitted.light)
    used[0] = False
    unit = np.broadcast_to(fitted.best.mask**2, used.shape)
    return robust_excess_sigma(fitted.best.errors[used] ** 2, noise[used], unit[used])


def _two_planes(problem: Problem, simple: Fitted, noise: PerShot) -> Fitted:
    """Return the best of several fits, which start with reflections brighter and fainter than the emitters."""
    prior, seen = problem.prior, problem.seen
    # Not above one plane's model error: with a much larger one, all starts would end at the prior's mean.
    error = typical_error(simple, seen)
    starts = [split_plane(simple.found.x, prior, reflection) for reflection in problem.rules.reflections]
    fits = [_from_afar(problem, TWO_PLANES, x, noise, error) for x in starts]
    return min(fits, key=lambda one: Profile.of(seen, one.ratio, noise).chi2 + prior.cost(one.found.x))


def _bad_shots(fitted: Fitted, rules: BackscatterRules) -> Bool[np.ndarray, " shots"]:
    """Find shots that dropped, flickered or show another picture, by brightness and by size of residuals."""
    z, used, weight = fitted.z, fitted.used, fitted.best.weight
    typical = np.array([np.median(np.abs(one[kept])) if kept.any() else 0.0 for one, kept in zip(z, used, strict=True)])
    bad = typical > rules.worse_pictures * max(float(np.median(typical[:-1])), ndtri(0.75))
    # Excess brightness over the model, relative to its light, in units of noise or of all shots' scatter.
    model = np.where(used, fitted.light * weight, 0.0)[:-1]
    information = np.maximum((model**2).sum(axis=(1, 2)), 1e-12)
    off = (z[:-1] * model).sum(axis=(1, 2)) / information
    off -= np.median(off)
    scatter = np.maximum(MAD_TO_SIGMA * np.median(np.abs(off)), 1 / np.sqrt(information))
    bad[:-1] |= BAD_PICTURES.off(off / scatter)
    return bad


def _without_outliers(problem: Problem, fitted: Fitted, good: Bool[np.ndarray, " shots"]) -> Usable:
    """Remove the worst sample of a bin, which may have biased the others, and fit the bin's mask again."""
    seen = problem.seen
    usable = seen.usable & good[:, None, None]
    for _ in range(4):
        best = Profile.of(seen, fitted.ratio, np.where(usable, fitted.best.weight, 0.0))
        used = best.weight > 0
        used[-1] = False
        z = np.where(used, np.abs(best.errors * best.weight), 0.0)
        usable = usable & ~(BAD_BINS.off(z, used) & (z == z.max(axis=0)))
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
    every, seen = problem.rules.held_out, problem.seen
    weight = full.best.weight.copy()
    weight[every:-1:every] = 0.0
    fitted = problem.solved(full.order, full.found.x, weight)
    used = full.used & (weight == 0)
    if not used.any():
        return 0.0, 0.0
    ratio, of_ratio = problem.ratios(fitted.found.x)
    noise = seen.variance(fitted.light) + fitted.best.light_variance(ratio, of_ratio, fitted.found.cov)
    excess = fitted.best.errors**2 - noise
    peak = np.maximum(np.where(used, fitted.light, 0.0).max(axis=(1, 2), keepdims=True), 1e-12)
    of_peak = float((excess / peak**2)[used].mean())
    # The rise of chi-squared by added pictures equals their chi-squared by the prediction's whole covariance.
    found = chi2_test(full.found.cost - fitted.found.cost, float(used.sum())).found
    unit = np.broadcast_to(fitted.best.mask**2, used.shape)[used].sum()
    of_white = float(excess[used].sum() / max(float(unit), 1e-30))
    return float(np.sqrt(max(of_peak, 0.0))), float(np.sqrt(max(of_white, 0.0)) * found)


def residual_pattern(found: Found) -> MisfitTest:
    """Test whether residuals of a shot and colour have the same sign over parts of the sensor or all of it."""
    fitted, cells, places, used = found.fitted, found.problem.rules.cells, found.places, found.fitted.used
    column, row = _cells(places, cells)
    groups = np.arange(used[..., 0].size).reshape(*used.shape[:2], 1)
    scale = max(fitted.best.chi2 / found.dof, 1.0) * found.dof / max(used.sum(), 1)
    tests = [
        group_means_test(fitted.z.ravel(), (groups * cells**2 + cell).ravel(), used.ravel(), scale)
        for cell in (row * cells + column, np.zeros(len(places), dtype=int))
    ]
    return sharper(*tests)


def _cells(places: Float[np.ndarray, "n 2"], across: int) -> Int[np.ndarray, "2 n"]:
    """(column, row) of the part of the sensor in which each place lies; there are so many ``across`` and down."""
    low, high = places.min(axis=0), places.max(axis=0)
    return np.minimum((places - low) / np.maximum(high - low, 1e-9) * across, across - 1).astype(int).T


def disagreement(found: Found) -> Vector:
    """Factors of the parameters' variances, above 1 where parts of the sensor ask for different values.

    A kernel that is wrong by an amount that changes slowly over the field hardly shows in residuals, which have the
    signs of the pictures' edges. But it moves a parameter by different amounts in different places, and then by more
    than independent residuals do. Each part moves the parameters by its score (``clustered_cov``). Parts are cells, and
    bands of rows and of columns. Where chance is no explanation for the scatter of any parameter, the model is refuted,
    and the scatter of every parameter is the measure of its sigma. So few parts tell it roughly: errors over it follow
    Student's t, whose variance is larger.
    """
    fitted, solved, across = found.fitted, found.fitted.found, found.problem.rules.cells
    dof, free = across**2 - 1, fitted.order.free
    errors, jacobian = found.problem.errors_at(fitted.best.weight)(solved.x)
    shifts = (jacobian @ solved.cov)[:, free]
    column, row = _cells(found.places, across)
    factors, tests = np.ones(len(solved.x)), [NO_TEST]
    for parts in (row * across + column, row, column):
        part = np.broadcast_to(parts, fitted.z.shape).ravel()
        square, expected = np.zeros((2, parts.max() + 1, free.sum()))
        np.add.at(square, part, shifts * errors[:, None])
        np.add.at(expected, part, shifts**2)
        square, seen = square**2, expected > 0
        statistics = np.divide(square, expected, out=np.zeros_like(square), where=seen).sum(axis=0)
        tests += [chi2_test(float(one), float(n - 1)) for one, n in zip(statistics, seen.sum(axis=0), strict=True)]
        wider = dof / (dof - 2) * square.sum(axis=0) / np.maximum(expected.sum(axis=0), 1e-300)
        factors[free] = np.maximum(factors[free], wider)
    return factors if sharper(*tests).found else np.ones(len(solved.x))


def value_moments(found: Found, inflation: float) -> Moments:
    """Return the values' moments by the chosen order; other orders widen the covariance by their probability.

    ``inflation`` is a factor of the noise's variance, above 1 where residuals have a pattern.
    """
    problem, fitted = found.problem, found.fitted
    free, solved, weight = fitted.order.free, fitted.found, fitted.best.weight / np.sqrt(inflation)
    errors_at = problem.errors_at(weight)
    if inflation > 1:
        # The prior stays the same: only the pictures hold less information.
        solved = most_probable(errors_at, solved.x, free, problem.prior, problem.rules.solver)
    own = moments_along_reflection(errors_at, solved, free, problem.prior, problem.rules)
    parts = [
        own if one is found.orders.best else Moments.log_normal(one.fit.found.x, one.fit.found.cov)
        for one in found.orders.tried
    ]
    return Moments.mixture(parts, found.orders.probabilities, own.mean)


def moments_along_reflection(
    errors_at: ErrorsAt, solved: MostProbable, free: Bool[np.ndarray, "18"], prior: Prior, rules: BackscatterRules
) -> Moments:
    """Return mean and covariance of the values around the most probable parameters.

    The log likelihood is close to a parabola in all of the solver's coordinates except the logarithm of the reflection.
    That has no bound once nearly all light, or nearly none, comes by way of the glass. Along it the posterior is
    computed at equal steps. At each step all other parameters are normal and are integrated out by Laplace's method
    (Tierney and Kadane, Journal of the American Statistical Association 81, 1986).
    """
    step = float(np.sqrt(max(solved.cov[REFLECTION, REFLECTION], 0.0)))
    # A posterior this narrow is normal: its mean is off by a twentieth of a sigma at most.
    if not free[REFLECTION] or step < 0.1 or not solved.converged:
        return Moments.log_normal(solved.x, solved.cov)
    others = free & (np.arange(len(free)) != REFLECTION)

    def node(start: Vector) -> tuple[MostProbable, float]:
        """Return the others at this reflection, and the posterior's logarithm there."""
        held = most_probable(errors_at, start, others, prior, rules.solver)
        off = float((start - prior.mean)[REFLECTION] / prior.sigma[REFLECTION])
        return held, -0.5 * evidence(held.cost + off**2, held.cov[np.ix_(others, others)], prior.sigma[others])

    nodes = [node(solved.x)]
    for sign in (1.0, -1.0):
        x, way = nodes[0][0].x, sign * solved.cov[:, REFLECTION] / step
        for _ in range(12):
            nodes.append(node(x + way))
            x, way = nodes[-1][0].x, nodes[-1][0].x - x
            # The variance grows with the square of the value, so that larger values have more weight.
            ahead = 2 * max(float(x[REFLECTION] - nodes[0][0].x[REFLECTION]), 0.0)
            if not nodes[-1][1] - nodes[0][1] + ahead > -6.0:
                break
    # With equal steps, sums approximate integrals of such smooth functions to many digits.
    weights = np.exp([log - max(log for _, log in nodes) for _, log in nodes])
    return Moments.mixture([Moments.log_normal(one.x, one.cov) for one, _ in nodes], weights / weights.sum())
