"""Likelihood of the backscatter term, and the most probable parameters of an order.

Light of shot i at a position and colour is  y_i = m r_i + u_i d + noise: r_i is the picture's light over that of white
(1 for white itself, 0 for the dark frame), m the mask and d the dark signal there, u_i the dark frame's exposure over
the shot's. m and d have no prior and enter linearly: they are profiled out exactly, bin by bin, so that the noise of
white and dark, which all pictures of a bin depend on, is weighed as it should be. Variances are of the model: shot
noise, what is left in the dark, and (e m)^2 for what the model leaves undescribed, e the model error relative to white.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.backscatter.data import BackscatterData, grid_step, sampled_rays
from udccal.fitting.backscatter.model import (
    PerBin,
    PerShot,
    Pictures,
    Profile,
    Windows,
    ratios,
    ratios_and_jacobian,
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

# Variance of a bin's count is never below this many e-^2: a black picture in a camera without read noise.
LEAST_VARIANCE = 1 / 12
# Parameters in the solver's coordinates to whitened errors and their Jacobian.
ErrorsAt = Callable[[Vector], tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]]


@final
@dataclass(frozen=True)
class Samples:
    """Shots at some positions, as in ``Binned``.

    Attributes:
        rays: of the positions, in panel coordinates.
        light: rates in e-/s above the black level.
        shot, rest: variance per rate, and that of light in the dark.
        usable: False where samples are clipped.
        exposure: that of the dark frame over that of each shot.
        shown: what the panel showed.
    """

    rays: Float[np.ndarray, "n 3"]
    light: PerShot
    shot: PerShot
    rest: PerShot
    usable: Bool[np.ndarray, "shots 3 n"]
    exposure: Float[np.ndarray, " shots"]
    shown: Pictures

    @classmethod
    def at(cls, data: BackscatterData, rays: Float[np.ndarray, "n 3"], flat: Int[np.ndarray, " n"]) -> Samples:
        """At grid positions with these rays and flat indices."""
        shots = data.shots
        light, shot, rest, clipped = (
            part.reshape(*part.shape[:2], -1)[:, :, flat]
            for part in (shots.rate, shots.shot, shots.rest, shots.clipped)
        )
        usable = ~clipped
        usable[-1] = True
        return cls(rays, light, shot, rest, usable, shots.exposure_s[-1] / shots.exposure_s, data.pictures)

    @property
    def excess(self) -> PerShot:
        """Light above that of the dark frame, as measured."""
        return self.light - self.exposure[:, None, None] * self.light[-1]

    def variance(self, rate: PerShot) -> PerShot:
        """Of every sample by noise, at this light."""
        return np.maximum(self.shot * np.maximum(rate, 0.0) + self.rest, LEAST_VARIANCE * self.shot**2)

    def weights(
        self, rate: PerShot, mask: PerBin, model_error: float, usable: Bool[np.ndarray, "shots 3 n"]
    ) -> PerShot:
        """1 / sigma of every sample, 0 where not usable, at this light of this mask."""
        variance = self.variance(rate)
        # White is the mask by definition, dark has no light: the model's error is in neither.
        variance[1:-1] += (model_error * mask) ** 2
        return np.where(usable, 1 / np.sqrt(variance), 0.0)

    def first_weights(self) -> PerShot:
        """Weights by what was measured, one electron on the safe side."""
        rate = np.maximum(self.excess, 0.0) + self.shot
        rate[-1] = 0.0
        return self.weights(rate, np.zeros(rate.shape[1:]), 0.0, self.usable)

    def profile(self, ratio: PerShot, weight: PerShot) -> Profile:
        """Mask and dark signal at their best."""
        return Profile.of(ratio, self.light, self.exposure, weight)


@final
@dataclass(frozen=True)
class SampleErrors:
    """Errors of samples as a function of the parameters: windows on the panel stay where they are."""

    template: Backscatter
    samples: Samples
    weight: PerShot
    at: Windows

    def ratios(self, x: Vector) -> tuple[PerShot, Float[np.ndarray, "18 shots 3 n"]]:
        """Light over that of white, and its derivatives by the solver's coordinates."""
        ratio, jacobian = ratios_and_jacobian(self.template, linear_of(x), self.at, self.samples.shown)
        return ratio, jacobian * linear_slope(x)[:, None, None, None]

    def __call__(self, x: Vector) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]:
        """Whitened errors, mask and dark at their best, and their Jacobian."""
        ratio, of_ratio = self.ratios(x)
        best = self.samples.profile(ratio, self.weight)
        return (best.errors * self.weight).ravel(), best.jacobian(of_ratio).reshape(len(x), -1).T


@final
@dataclass(frozen=True)
class MostProbable:
    """The most probable parameters; ``cov`` is 0 for those that are held, ``cost`` holds what the prior adds."""

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
    """Where errors and prior together are least, over the free parameters."""
    problem = _Free(errors_at, free, Prior(prior.mean[free], prior.root[:, free]))
    found, cov = minimise(problem, start, rules), np.zeros((len(free), len(free)))
    if np.isfinite(found.equations.cost):
        cov[np.ix_(free, free)] = found.equations.cov()
    return MostProbable(found.place, cov, found.equations.cost, found.converged)


@final
@dataclass(frozen=True)
class Fitted:
    """An order's parameters, and what they make of the samples with mask and dark at their best."""

    order: Order
    found: MostProbable
    at: Windows
    ratio: PerShot
    best: Profile

    @property
    def light(self) -> PerShot:
        """Modelled light, the dark signal left out."""
        return self.best.mask * self.ratio

    @property
    def z(self) -> PerShot:
        """Errors in units of their sigma, 0 where not used."""
        return self.best.errors * self.best.weight

    @property
    def used(self) -> Bool[np.ndarray, "shots 3 n"]:
        """Samples that count, dark left out."""
        used = self.best.weight > 0
        used[-1] = False
        return used

    def weighed(self, weight: PerShot) -> Fitted:
        """The same, mask and dark too, looked at with other weights."""
        return replace(self, best=replace(self.best, weight=weight))

    def dof(self, prior: Prior) -> float:
        """Samples less one mask per bin (the dark signal has a sample of its own) less parameters.

        A parameter that its prior holds takes less than one.
        """
        narrowed = np.where(self.order.free, np.diag(self.found.cov) / prior.sigma**2, 1.0)
        used = self.used
        return max(float(used.sum() - used.any(axis=0).sum() - np.maximum(1.0 - narrowed, 0.0).sum()), 1.0)


@final
@dataclass(frozen=True)
class Problem:
    """What all orders have in common; ``flat`` are the grid indices of the positions."""

    template: Backscatter
    samples: Samples
    flat: Int[np.ndarray, " n"]
    prior: Prior
    start: Vector
    rules: BackscatterRules

    @classmethod
    def of(
        cls, data: BackscatterData, geometry: Geometry, rig: RigDescription, rules: BackscatterRules | None = None
    ) -> Problem:
        """Samples at positions spread over the sensor; the start is at the best offset of whole panel pixels."""
        rules, step, prior = rules or BackscatterRules(), grid_step(rig), prior_of(rig)
        rays, flat = sampled_rays(geometry, rig, step, rules.positions)
        # The mask comes out of the likelihood; the template's is of no size.
        template = nominal_backscatter(geometry, rig, np.zeros((3, 1, 1)), step, window=1)
        template = replace(template, window=window_for(template, linear_of(prior.mean), rays, rules.slack_px))
        samples, start = Samples.at(data, rays, flat), prior.mean.copy()
        weight = samples.first_weights()

        def cost(offset: tuple[int, int]) -> float:
            start[OFFSET] = offset
            at = Windows.around(template, linear_of(start), rays, samples.shown.crop)
            return samples.profile(ratios(template, linear_of(start), at, samples.shown), weight).chi2

        across, down = (range(-int(np.ceil(reach)), int(np.ceil(reach)) + 1) for reach in prior.sigma[OFFSET])
        start[OFFSET] = min(((x, y) for y in down for x in across), key=cost)
        return cls(template, samples, flat, prior, start, rules)

    def solved(self, order: Order, x: Vector, weight: PerShot) -> Fitted:
        """The most probable parameters of an order at given weights, from ``x`` on."""
        start, samples = order.start(x, self.prior), self.samples
        at = Windows.around(self.template, linear_of(start), samples.rays, samples.shown.crop)
        errors_at = SampleErrors(self.template, samples, weight, at)
        found = most_probable(errors_at, start, order.free, self.prior, self.rules.solver)
        ratio = ratios(self.template, linear_of(found.x), at, samples.shown)
        return Fitted(order, found, at, ratio, samples.profile(ratio, weight))

    def with_room(self, x: Vector) -> Problem:
        """With windows that hold the footprints of these parameters and let them move, never smaller than before.

        They stay where they would have to be far wider: such a fit has gone astray.
        """
        theta, rays, window, rules = linear_of(x), self.samples.rays, self.template.window, self.rules
        if not window < window_for(self.template, theta, rays, 0.0) <= rules.most_wider * window:
            return self
        return replace(
            self, template=replace(self.template, window=window_for(self.template, theta, rays, rules.slack_px))
        )
