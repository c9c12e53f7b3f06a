"""Likelihood of the backscatter term, and the most probable parameters of an order.

Light of shot i at a position and colour is  y_i = m r_i + u_i d + noise. r_i is the picture's light over that of white
(1 for white itself, 0 for the dark frame), m the mask and d the dark signal there, u_i the dark frame's exposure over
the shot's. m and d have no prior and enter linearly: they are eliminated exactly, bin by bin, so that the noise of
white and dark, which is common to all pictures of a bin, has its right weight. The model gives the variances: shot
noise, noise in the dark, and (e m)^2 for the model error e, which is relative to white.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.backscatter.data import BackscatterData, Binned, grid_step, sampled_rays
from udccal.fitting.backscatter.model import (
    Moves,
    PerBin,
    PerShot,
    Pictures,
    Rays,
    Shares,
    Usable,
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
)
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import Blocks, SolverRules, Step, minimise
from udccal.fitting.nominal import nominal_backscatter
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64
from udccal.rig import RigDescription

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
        cov[np.ix_(free, free)] = found.with_rest(found.equations.cov(), found.equations.step(0.0).shared)
    return MostProbable(found.place, cov, found.equations.cost, found.converged)


@final
@dataclass(frozen=True)
class Profile:
    """The most probable mask and dark signal for given ratios, bin by bin.

    Attributes:
        mask, dark: e-/s.
        errors: measured less modelled rates; ``weight`` is 1 / sigma of each.
        information: on the mask, with the dark signal eliminated.
        by_mask, by_dark: orthonormal directions of the whitened errors that mask and dark remove.
    """

    mask: PerBin
    dark: PerBin
    errors: PerShot
    weight: PerShot
    information: PerBin
    by_mask: PerShot
    by_dark: PerShot

    @property
    def chi2(self) -> float:
        """Chi-squared without the prior."""
        return float(((self.errors * self.weight) ** 2).sum())

    @classmethod
    def of(cls, seen: Binned, ratio: PerShot, weight: PerShot) -> Profile:
        """Solve for mask and dark signal from the ratios of all shots."""
        light, exposure = seen.rate, (seen.exposure_s[-1] / seen.exposure_s)[:, None, None]
        apart = exposure * weight
        length = np.sqrt((apart**2).sum(axis=0))
        by_dark = apart / length
        across = ratio * weight - by_dark * (by_dark * ratio * weight).sum(axis=0)
        information = (across**2).sum(axis=0)
        root = np.sqrt(np.where(information > 0, information, 1.0))
        by_mask = across / root
        mask = (by_mask * light * weight).sum(axis=0) / root
        dark = (by_dark * (light - mask * ratio) * weight).sum(axis=0) / length
        return cls(mask, dark, light - mask * ratio - exposure * dark, weight, information, by_mask, by_dark)

    def jacobian(self, of_ratio: Moves) -> Moves:
        """Return the whitened errors' Jacobian without the parts that mask and dark remove (Kaufman, BIT 15, 1975)."""
        jacobian = -(self.mask * self.weight) * of_ratio
        for way in (self.by_dark, self.by_mask):
            jacobian -= way * np.einsum("scn,kscn->kcn", way, jacobian)[:, None]
        return jacobian

    def mask_jacobian(self, of_ratio: Moves) -> Float[np.ndarray, "k 3 n"]:
        """Return the mask's derivatives for the expected light; the contribution of noise is of second order."""
        along = np.einsum("scn,kscn->kcn", self.by_mask * self.weight, of_ratio)
        return -self.mask * along / np.sqrt(np.where(self.information > 0, self.information, 1.0))

    def light_variance(self, ratio: PerShot, of_ratio: Moves, cov: Float[np.ndarray, "k k"]) -> PerShot:
        """Return predicted light's variance: from the parameters and their effect on the mask, and from its noise."""
        moves = self.mask * of_ratio + ratio * self.mask_jacobian(of_ratio)[:, None]
        by_parameters = np.einsum("kicn,kl,licn->icn", moves, cov, moves, optimize=True)
        return np.asarray(by_parameters + ratio**2 / np.maximum(self.information, 1e-30))


@final
@dataclass(frozen=True)
class Fitted:
    """An order's parameters, its ratios of all samples, and the most probable mask and dark signal."""

    order: Order
    found: MostProbable
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
        # Beyond this width a fit has gone astray.
        most = int(rules.most_wider * window_for(template, linear_of(prior.mean), rays, 0.5))
        template = replace(template, window=most)
        seen, shown, start = data.shots.at(flat), data.pictures, prior.mean.copy()
        weight = seen.first_weights()

        theta = linear_of(start)
        shares, panel = Shares.of(template, theta, rays), shown.light(float(theta[0]))[0]

        def cost(offset: tuple[int, int]) -> float:
            # An offset of whole pixels leaves the shares as they are.
            moved = replace(shares, panel_px=shares.panel_px - offset)
            return Profile.of(seen, ratios_of(theta, moved.light(shown, panel)), weight).chi2

        across, down = (range(-int(np.ceil(reach)), int(np.ceil(reach)) + 1) for reach in prior.sigma[OFFSET])
        start[OFFSET] = min(((x, y) for y in down for x in across), key=cost)
        return cls(template, seen, shown, rays, flat, prior, start, rules)

    def solved(self, order: Order, x: Vector, weight: PerShot) -> Fitted:
        """Solve for the most probable parameters of an order at given weights, from ``x`` on."""
        start = order.start(x, self.prior)
        found = most_probable(self.errors_at(weight), start, order.free, self.prior, self.rules.solver)
        ratio = ratios(self.template, linear_of(found.x), self.rays, self.shown)
        return Fitted(order, found, ratio, Profile.of(self.seen, ratio, weight))

    def ratios(self, x: Vector) -> tuple[PerShot, Moves]:
        """Return light over that of white, and its derivatives by the solver's coordinates."""
        ratio, jacobian = ratios_and_jacobian(self.template, linear_of(x), self.rays, self.shown)
        return ratio, jacobian * linear_slope(x)[:, None, None, None]

    def errors_at(self, weight: PerShot) -> ErrorsAt:
        """Return a function for whitened errors, with the best mask and dark, and their Jacobian."""

        def of(x: Vector) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]:
            ratio, of_ratio = self.ratios(x)
            best = Profile.of(self.seen, ratio, weight)
            return (best.errors * weight).ravel(), best.jacobian(of_ratio).reshape(len(x), -1).T

        return of
