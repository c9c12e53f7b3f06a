"""The posterior of the backscatter fit: moments of the parameters, what misfits add to them, and the term they make.

Residuals may show patterns, parts of the sensor that disagree, and pictures of unequal brightness besides noise.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import block_diag

from udccal.fitting.backscatter.data import BackscatterData, Profile
from udccal.fitting.backscatter.model import Rays, grid_rays, ratios, ratios_and_jacobian, window_for
from udccal.fitting.backscatter.other_light import Beside, PanelCurve
from udccal.fitting.backscatter.parameters import (
    LOGARITHMIC,
    REFLECTION,
    Cov,
    ErrorsAt,
    Free,
    MostProbable,
    Vector,
    linear_of,
    linear_slope,
    most_probable,
    value_slope,
    values_of,
    with_linear,
)
from udccal.fitting.backscatter.search import Found
from udccal.fitting.engine.gaussian import Posterior, Prior, square_root
from udccal.fitting.engine.misfit import NO_TEST, MisfitTest, chi2_test, excess_sigma, f_tail, group_means_test, sharper
from udccal.fitting.engine.orders import evidence
from udccal.models.backscatter import Backscatter
from udccal.numerics import in_float64

# Interpolation never combines bins at this distance.
_TILE = 4


def scaled(cov: Float[np.ndarray, "n n"], slope: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of numbers with these derivatives by the parameters of ``cov``."""
    return np.asarray(cov * np.outer(slope, slope))


@final
@dataclass(frozen=True)
class Moments:
    """Mean and covariance of parameters, such as the values in the units of the estimates."""

    mean: Vector
    cov: Cov

    @classmethod
    def log_normal(cls, x: Vector, cov: Cov) -> Moments:
        """Return the moments of the values if the solver's coordinates are normal."""
        mean = values_of(x) * np.where(LOGARITHMIC, np.exp(0.5 * np.diag(cov)), 1.0)
        both = np.outer(LOGARITHMIC, LOGARITHMIC)
        return cls(mean, scaled(np.where(both, np.expm1(cov), cov), value_slope(mean)))

    @classmethod
    def mixture(
        cls, parts: Sequence[Moments], weights: Float[np.ndarray, " parts"], mean: Vector | None = None
    ) -> Moments:
        """Combine each part's covariance and its distance from ``mean``, by default from the mean of all."""
        means = np.stack([one.mean for one in parts])
        off = means - (mean := weights @ means if mean is None else mean)
        within = np.einsum("p,pkl->kl", weights, np.stack([one.cov for one in parts]))
        return cls(mean, within + np.einsum("p,pk,pl->kl", weights, off, off))


def moments_along_reflection(errors_at: ErrorsAt, solved: MostProbable, free: Free, prior: Prior) -> Moments:
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
        held = most_probable(errors_at, start, others, prior)
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


def value_moments(found: Found, inflation: float) -> Moments:
    """Return the values' moments; ``inflation`` is the factor of the noise's variance that a pattern asks for."""
    problem, free, solved = found.problem, found.fitted.order.free, found.fitted.found
    errors_at = problem.errors_at(found.fitted.best.weight / np.sqrt(inflation))
    if inflation > 1:
        # The prior stays the same: only the pictures hold less information.
        solved = most_probable(errors_at, solved.x, free, problem.prior)
    own = moments_along_reflection(errors_at, solved, free, problem.prior)
    return _over_orders(found, own, lambda other: Moments.log_normal(other.x, other.cov))


def linear_cov(found: Found, inflation: Vector) -> Cov:
    """Return the covariance of the numbers of ``linear_of``; ``inflation`` has factors of the parameters' variances."""

    def moments(of: MostProbable, factor: Vector | float = 1.0) -> Moments:
        return Moments(linear_of(of.x), scaled(of.cov, linear_slope(of.x) * np.sqrt(factor)))

    return _over_orders(found, moments(found.fitted.found, inflation), moments).cov


def _over_orders(found: Found, own: Moments, moments: Callable[[MostProbable], Moments]) -> Moments:
    """Return the chosen order's moments; other orders widen the covariance by their probability."""
    orders = found.orders
    parts = [own if one is orders.best else moments(one.fit.found) for one in orders.tried]
    return Moments.mixture(parts, orders.probabilities, own.mean)


@final
@dataclass(frozen=True)
class Misfits:
    """What residuals show besides noise.

    Attributes:
        pattern: test whether residuals of a shot and colour have the same sign over parts of the sensor or all of it.
        brightness, brightness_test: relative scatter of the shots' brightness, 0 where chance explains it; its test.
        curve: how the panel's light by code differs from a power.
        by_panel: what brightness and curve add to the covariance of the solver's parameters.
        wider: factors of the parameters' variances, above 1 where parts of the sensor ask for different values.
    """

    pattern: MisfitTest
    brightness: float
    brightness_test: MisfitTest
    curve: PanelCurve
    by_panel: Cov
    wider: Vector

    @classmethod
    def of(cls, found: Found) -> Misfits:
        """Test the residuals of a fit."""
        errors, jacobian = found.problem.linearised(found.fitted)
        curve = PanelCurve.of(found.problem, found.fitted, errors, jacobian)
        sigma, test, cov, rest = _brightness(found, curve.rest, jacobian)
        wider = _disagreement(found, rest, jacobian)
        return cls(_pattern(found), sigma, test, curve, curve.cov + cov, wider)


def _pattern(found: Found) -> MisfitTest:
    best, used, cells = found.fitted.best, found.fitted.used, _cells(found)[0]
    groups = np.arange(used[..., 0].size).reshape(*used.shape[:2], 1) * (cells.max() + 1)
    scale = max(best.chi2 / found.dof, 1.0) * found.dof / max(used.sum(), 1)
    each = ((groups + parts).ravel() for parts in (cells, 0 * cells))
    return sharper(*(group_means_test(best.z.ravel(), group, used.ravel(), scale) for group in each))


def _cells(found: Found) -> tuple[Int[np.ndarray, " n"], ...]:
    """Return the part of the sensor in which each position lies: its cell, its band of rows and of columns."""
    places, across = found.places, found.problem.rules.cells
    low, high = places.min(axis=0), places.max(axis=0)
    column, row = np.minimum((places - low) / np.maximum(high - low, 1e-9) * across, across - 1).astype(int).T
    return row * across + column, row, column


def _brightness(
    found: Found, errors: Float[np.ndarray, " m"], jacobian: Float[np.ndarray, "m 18"]
) -> tuple[float, MisfitTest, Cov, Float[np.ndarray, " m"]]:
    """Tell whether the panel was brighter in some shots than in others, each by a part of its light.

    Parameters follow most of that: what residuals still show of it is compared with what they would show. The shots
    are few, so that the scatter is known roughly: errors over it follow Student's t, whose variance is larger.

    Returns:
        relative scatter, 0 where chance explains it; its test; what it adds to the covariance; errors without it.
    """
    fitted = found.fitted
    each = np.arange(len(fitted.ratio) - 1)
    moves = np.zeros((len(each), *fitted.ratio.shape))
    moves[each, each] = -fitted.ratio[:-1]
    beside = Beside.of(fitted, jacobian, moves)
    amount, size, dof = beside.amounts(errors), beside.size, len(beside.size)
    rest = errors + beside.left @ (beside.ways @ amount)
    # Brightness is common to the colours: a kernel that is wrong leaves as much by colour as it seems to explain.
    by_colour = beside.whole.reshape(*fitted.ratio.shape, -1)
    along = np.einsum("scn,scnk->ck", rest.reshape(fitted.ratio.shape), by_colour) ** 2
    along /= np.maximum((by_colour**2).sum(axis=(0, 2)), 1e-300)
    scale = max(fitted.best.chi2 / found.dof, float(along.sum()) / max(along.size - dof, 1), 1.0)
    statistic = float(np.sum(amount**2 * size)) / scale
    test = MisfitTest(statistic / max(dof, 1), f_tail(statistic / max(dof, 1), dof, along.size - dof))
    sigma = excess_sigma(amount**2, scale / size, np.ones(dof), float(dof)) if dof > 2 and test.found else 0.0
    # A wrong kernel's errors are larger bin by bin than what a picture's bins have in common.
    if sigma <= found.problem.rules.brightness * found.model_error:
        return 0.0, test, np.zeros_like(fitted.found.cov), errors
    return sigma, test, dof / (dof - 2) * sigma**2 * beside.shifts @ beside.shifts.T, rest


def _disagreement(found: Found, errors: Float[np.ndarray, " m"], jacobian: Float[np.ndarray, "m 18"]) -> Vector:
    """Factors of the parameters' variances, above 1 where parts of the sensor ask for different values by ``errors``.

    A kernel that is wrong by an amount that changes slowly over the field hardly shows in residuals, which have the
    signs of the pictures' edges. But it moves a parameter by different amounts in different places, and then by more
    than independent residuals do. Each part moves the parameters by its score (``clustered_cov``). Where chance is no
    explanation for the scatter of any parameter, the model is refuted, and the scatter of every parameter is the
    measure of its sigma. So few parts tell it roughly: errors over it follow Student's t, whose variance is larger.
    """
    solved, free, shape = found.fitted.found, found.fitted.order.free, found.fitted.ratio.shape
    shifts, factors, tests = (jacobian @ solved.cov)[:, free], np.ones(len(free)), [NO_TEST]
    dof = found.problem.rules.cells**2 - 1
    for parts in _cells(found):
        member = 1.0 * (np.broadcast_to(parts, shape).ravel() == np.unique(parts)[:, None])
        square, expected = (member @ (shifts * errors[:, None])) ** 2, np.maximum(member @ shifts**2, 1e-300)
        tests += [chi2_test(float(one), len(member) - 1.0) for one in (square / expected).sum(axis=0)]
        wider = dof / (dof - 2) * square.sum(axis=0) / expected.sum(axis=0)
        factors[free] = np.maximum(factors[free], wider)
    return factors if sharper(*tests).found else np.ones(len(free))


@final
@dataclass(frozen=True)
class TermAt:
    """The term as a function of its parameters (``linear_of``), and of ``_TILE`` squared numbers of the mask's noise.

    The mask is the most probable one for all shots and follows the parameters linearly. Bins with the same number are
    so far from each other that no interpolated value depends on two of them. Their signs are random, so that sums over
    the sensor are right on average.
    """

    template: Backscatter
    data: BackscatterData
    good: Bool[np.ndarray, " shots"]
    model_error: float
    theta: Vector

    @classmethod
    def of(cls, data: BackscatterData, found: Found) -> TermAt:
        """The term of a fit, from all shots over the whole grid."""
        theta, template, shape = linear_of(found.fitted.found.x), found.problem.template, data.shots.rate.shape[2:]
        rays = grid_rays(template.geometry, shape, template.step, np.arange(shape[0] * shape[1]))
        template = replace(template, window=window_for(template, theta, rays, slack=0.5))
        return cls(template, data, found.good, found.model_error, theta)

    @in_float64
    def __call__(self, parameters: Float[np.ndarray, " n"]) -> Backscatter:
        """Return the term; its mask is never below 0."""
        (theta, noise), (mask, sigma) = np.split(parameters, [len(self.theta)]), self.mask
        down, across = np.indices(mask.shape[1:]) % _TILE
        mask = mask + sigma * noise.reshape(_TILE, _TILE)[down, across]
        if (moved := theta - self.theta).any():
            mask = mask + np.einsum("k,kcij->cij", moved, self._mask_jacobian)
        return replace(with_linear(self.template, theta), mask=np.maximum(mask, 0.0))

    @functools.cached_property
    def mask(self) -> tuple[Float[np.ndarray, "3 a b"], Float[np.ndarray, "3 a b"]]:
        """Light of white over the whole grid, and its sigma with a random sign, in e-/s."""
        shape = self.data.shots.rate.shape[1:]
        parts = [(np.maximum(one.mask, 0.0), np.maximum(one.information, 1e-30)) for _, one in self._profiles(512)]
        mask, information = (np.concatenate(part, axis=1).reshape(shape) for part in zip(*parts, strict=True))
        return mask, np.random.default_rng(0).choice([-1.0, 1.0], shape) / np.sqrt(information)

    @functools.cached_property
    def _mask_jacobian(self) -> Float[np.ndarray, "18 3 a b"]:
        """Derivatives of the mask by the parameters, computed only when the posterior is used."""
        parts = [
            best.mask_jacobian(ratios_and_jacobian(self.template, self.theta, rays, self.data.pictures)[1])
            for rays, best in self._profiles(256)
        ]
        return np.concatenate(parts, axis=2).reshape(-1, *self.data.shots.rate.shape[1:])

    def _profiles(self, size: int) -> Iterator[tuple[Rays, Profile]]:
        """Rays, mask and dark signal of ``size`` positions at once: first with the data's weights, then the model's."""
        shots, template = self.data.shots, self.template
        every = np.arange(shots.rate[0, 0].size)
        for flat in np.split(every, every[size::size]):
            rays, seen = grid_rays(template.geometry, shots.rate.shape[2:], template.step, flat), shots.at(flat)
            usable = seen.usable & self.good[:, None, None]
            ratio = ratios(template, self.theta, rays, self.data.pictures)
            best = Profile.of(seen, ratio, seen.first_weights(usable))
            for _ in range(2):
                best = Profile.of(seen, ratio, seen.weights(best.mask * ratio, best.mask, self.model_error, usable))
            yield rays, best

    def posterior(self, cov: Cov) -> Posterior[Backscatter]:
        """Return the posterior with this covariance of the parameters, and with the mask's noise."""
        factor = block_diag(square_root(cov), np.eye(_TILE**2))
        return Posterior(np.concatenate([self.theta, np.zeros(_TILE**2)]), factor, self)
