"""Likelihood of the backscatter term, and the most probable parameters of an order.

Light of shot i at a position and colour is  y_i = m r_i + u_i d + noise. r_i is the picture's light over that of white
(1 for white itself, 0 for the dark frame), m the mask and d the dark signal there, u_i the dark frame's exposure over
the shot's. m and d have no prior and enter linearly: they are eliminated exactly, bin by bin, so that the noise of
white and dark, which is common to all pictures of a bin, has its right weight. The model gives the variances: shot
noise, noise in the dark, and (e m)^2 for the model error e, which is relative to white.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.backscatter.data import BackscatterData, Binned, grid_rays, grid_step, sampled_rays
from udccal.fitting.backscatter.model import (
    Moves,
    PerShot,
    Pictures,
    Profile,
    Rays,
    Shares,
    Usable,
    Windows,
    ratios,
    ratios_and_jacobian,
    ratios_of,
    window_for,
)
from udccal.fitting.backscatter.parameters import (
    OFFSET,
    BackscatterRules,
    Order,
    Vector,
    linear_of,
    linear_slope,
    prior_of,
    with_linear,
)
from udccal.fitting.engine.gaussian import Posterior, Prior, square_root
from udccal.fitting.engine.least_squares import Blocks, SolverRules, Step, minimise
from udccal.fitting.nominal import nominal_backscatter
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64
from udccal.rig import RigDescription

# Interpolation never combines bins at this distance.
_TILE = 4
# Parameters in the solver's coordinates to whitened errors and their Jacobian.
ErrorsAt = Callable[[Vector], tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]]


@final
@dataclass(frozen=True)
class MostProbable:
    """The most probable parameters; ``cov`` is 0 for those that are held, ``cost`` includes the prior's part."""

    x: Vector
    cov: Float[np.ndarray, "18 18"]
    cost: float
    converged: bool


@final
@dataclass(frozen=True)
class _Free:
    """The free parameters as the engine's problem; the others are held."""

    errors_at: ErrorsAt
    free: Bool[np.ndarray, "18"]
    prior: Prior
    name: str = "backscatter"

    def equations_at(self, place: Vector) -> Blocks:
        errors, jacobian = self.errors_at(place)
        return Blocks.of_errors(errors, jacobian[:, self.free]).with_prior(self.prior, place[self.free])

    def moved(self, place: Vector, step: Step) -> Vector:
        moved = place.copy()
        moved[self.free] += step.shared
        return moved


@in_float64
def most_probable(
    errors_at: ErrorsAt, start: Vector, free: Bool[np.ndarray, "18"], prior: Prior, rules: SolverRules | None = None
) -> MostProbable:
    """Minimise the cost of errors and prior over the free parameters."""
    problem = _Free(errors_at, free, Prior(prior.mean[free], prior.root[:, free]))
    found, cov = minimise(problem, start, rules), np.zeros((len(free), len(free)))
    if np.isfinite(found.equations.cost):
        cov[np.ix_(free, free)] = found.equations.cov()
    return MostProbable(found.place, cov, found.equations.cost, found.converged)


@final
@dataclass(frozen=True)
class Fitted:
    """An order's parameters, its ratios of all samples, and the most probable mask and dark signal."""

    order: Order
    found: MostProbable
    at: Windows
    ratio: PerShot
    best: Profile

    @property
    def light(self) -> PerShot:
        """Modelled light without the dark signal, in e-/s."""
        return self.best.mask * self.ratio

    @property
    def z(self) -> PerShot:
        """Errors in units of their sigma, 0 for unused samples."""
        return self.best.errors * self.best.weight

    @property
    def used(self) -> Usable:
        """Samples with a weight, without the dark frame's."""
        used = self.best.weight > 0
        used[-1] = False
        return used

    def weighed(self, weight: PerShot) -> Fitted:
        """Return the same parameters, mask and dark signal with other weights."""
        return replace(self, best=replace(self.best, weight=weight))

    def dof(self, prior: Prior) -> float:
        """Return samples less one mask per bin (the dark signal has a sample of its own) less parameters."""
        # A parameter that its prior determines counts less than one.
        narrowed = np.where(self.order.free, np.diag(self.found.cov) / prior.sigma**2, 1.0)
        used = self.used
        return max(float(used.sum() - used.any(axis=0).sum() - np.maximum(1.0 - narrowed, 0.0).sum()), 1.0)


@final
@dataclass(frozen=True)
class Problem:
    """The common part of all orders; ``flat`` are the positions' grid indices, ``rays`` are in panel coordinates."""

    template: Backscatter
    seen: Binned
    shown: Pictures
    rays: Rays
    flat: Int[np.ndarray, " n"]
    prior: Prior
    start: Vector
    rules: BackscatterRules

    @classmethod
    def of(
        cls, data: BackscatterData, geometry: Geometry, rig: RigDescription, rules: BackscatterRules | None = None
    ) -> Problem:
        """Take samples at positions spread over the sensor, and start at the best offset of whole panel pixels."""
        rules, step, prior = rules or BackscatterRules(), grid_step(rig), prior_of(rig)
        rays, flat = sampled_rays(geometry, rig, step, rules.positions)
        # The likelihood gives the mask; the template's has a single bin.
        template = nominal_backscatter(geometry, rig, np.zeros((3, 1, 1)), step, window=1)
        template = replace(template, window=window_for(template, linear_of(prior.mean), rays, rules.slack_px))
        seen, shown, start = data.shots.at(flat), data.pictures, prior.mean.copy()
        weight = seen.first_weights()

        theta = linear_of(start)
        at = Windows.around(template, theta, rays)
        shares, panel = Shares.of(template, theta, at), shown.light(float(theta[0]))[0]

        def cost(offset: tuple[int, int]) -> float:
            # An offset of whole pixels leaves the shares as they are.
            moved = replace(shares, panel_px=shares.panel_px - offset)
            return seen.profile(ratios_of(theta, moved.light(shown, panel)), weight).chi2

        across, down = (range(-int(np.ceil(reach)), int(np.ceil(reach)) + 1) for reach in prior.sigma[OFFSET])
        start[OFFSET] = min(((x, y) for y in down for x in across), key=cost)
        return cls(template, seen, shown, rays, flat, prior, start, rules)

    def solved(self, order: Order, x: Vector, weight: PerShot) -> Fitted:
        """Solve for the most probable parameters of an order at given weights, from ``x`` on."""
        start = order.start(x, self.prior)
        at = Windows.around(self.template, linear_of(start), self.rays)
        found = most_probable(self.errors_at(weight, at), start, order.free, self.prior, self.rules.solver)
        ratio = ratios(self.template, linear_of(found.x), at, self.shown)
        return Fitted(order, found, at, ratio, self.seen.profile(ratio, weight))

    def ratios(self, x: Vector, at: Windows) -> tuple[PerShot, Moves]:
        """Return light over that of white, and its derivatives by the solver's coordinates."""
        ratio, jacobian = ratios_and_jacobian(self.template, linear_of(x), at, self.shown)
        return ratio, jacobian * linear_slope(x)[:, None, None, None]

    def errors_at(self, weight: PerShot, at: Windows) -> ErrorsAt:
        """Return a function for whitened errors, with the best mask and dark, and their Jacobian; windows stay."""

        def of(x: Vector) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]:
            ratio, of_ratio = self.ratios(x, at)
            best = self.seen.profile(ratio, weight)
            return (best.errors * weight).ravel(), best.jacobian(of_ratio).reshape(len(x), -1).T

        return of

    def with_room(self, x: Vector) -> Problem:
        """Return the problem with windows wide enough for these parameters, unless the fit has gone far astray."""
        theta, rules, template = linear_of(x), self.rules, self.template
        if not template.window < window_for(template, theta, self.rays, 0.0) <= rules.most_wider * template.window:
            return self
        window = window_for(template, theta, self.rays, rules.slack_px)
        return replace(self, template=replace(template, window=window))


@final
@dataclass(frozen=True)
class TermAt:
    """The term as a function of its parameters (``linear_of``), and of ``_TILE`` squared numbers of the mask's noise.

    The mask is the most probable one for all shots, which determine it better than white alone. It follows the
    parameters linearly. Bins with the same number are so far from each other that no interpolated value depends on two
    of them. Their signs are random, so that sums over the sensor are right on average.
    """

    template: Backscatter
    data: BackscatterData
    used: Bool[np.ndarray, " shots"]
    model_error: float
    theta: Vector

    @in_float64
    def __call__(self, parameters: Float[np.ndarray, " n"]) -> Backscatter:
        """Return the term; its mask is never below 0."""
        theta, noise = parameters[: len(self.theta)], parameters[len(self.theta) :].reshape(_TILE, _TILE)
        mask, sigma = self._mask
        rows, columns = mask.shape[1:]
        mask = mask + sigma * np.tile(noise, (-(-rows // _TILE), -(-columns // _TILE)))[:rows, :columns]
        if (moved := theta - self.theta).any():
            mask = mask + np.einsum("k,kcij->cij", moved, self._mask_jacobian)
        return replace(with_linear(self.template, theta), mask=np.maximum(mask, 0.0))

    @functools.cached_property
    def _mask(self) -> tuple[Float[np.ndarray, "3 a b"], Float[np.ndarray, "3 a b"]]:
        """Light of white over the whole grid, and its sigma with a random sign, in e-/s."""
        found = [self._best(flat)[1] for flat in self._parts(512)]
        mask = np.concatenate([one.mask for one in found], axis=1)
        sigma = np.concatenate([np.maximum(one.information, 1e-30) for one in found], axis=1) ** -0.5
        sign = np.random.default_rng(0).choice([-1.0, 1.0], mask.shape)
        shape = self.data.shots.rate.shape[1:]
        return np.maximum(mask, 0.0).reshape(shape), (sign * sigma).reshape(shape)

    @functools.cached_property
    def _mask_jacobian(self) -> Float[np.ndarray, "18 3 a b"]:
        """Derivatives of the mask by the parameters, computed only when the posterior is used."""
        parts = []
        for flat in self._parts(256):
            at, best = self._best(flat)
            of_ratio = ratios_and_jacobian(self.template, self.theta, at, self.data.pictures)[1]
            parts.append(best.mask_jacobian(of_ratio))
        return np.concatenate(parts, axis=2).reshape(-1, *self.data.shots.rate.shape[1:])

    def _parts(self, size: int) -> list[Int[np.ndarray, " n"]]:
        """Split the grid positions into parts of ``size``, which fit into memory."""
        flat = np.arange(self.data.shots.rate[0, 0].size)
        return np.split(flat, flat[size::size])

    def _best(self, flat: Int[np.ndarray, " n"]) -> tuple[Windows, Profile]:
        """Return windows, mask and dark signal: first with the data's weights, then with the model's."""
        rays = grid_rays(self.template.geometry, self.data.shots.rate.shape[2:], self.template.step, flat)
        at = Windows.around(self.template, self.theta, rays)
        seen = self.data.shots.at(flat)
        usable = seen.usable & self.used[:, None, None]
        ratio = ratios(self.template, self.theta, at, self.data.pictures)
        best = seen.profile(ratio, np.where(usable, seen.first_weights(), 0.0))
        for _ in range(2):
            best = seen.profile(ratio, seen.weights(best.mask * ratio, best.mask, self.model_error, usable))
        return at, best

    def posterior(self, cov: Float[np.ndarray, "18 18"]) -> Posterior[Backscatter]:
        """Return the posterior with this covariance of the parameters, and with the mask's noise."""
        count, noise = len(cov), _TILE**2
        factor = np.eye(count + noise)
        factor[:count, :count] = square_root(cov)
        return Posterior(np.concatenate([self.theta, np.zeros(noise)]), factor, self)
