"""The most probable parameters of an order: the problem, its errors as the engine sees them, and the descent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.backscatter.data import BackscatterData, grid_step, sampled_rays
from udccal.fitting.backscatter.likelihood import PerBin, PerShot, Profile, Samples, of_all_shots
from udccal.fitting.backscatter.parameters import (
    OFFSET,
    TWO_PLANES,
    Order,
    Vector,
    linear_of,
    linear_slope,
    offset_reach_px,
    prior_of,
)
from udccal.fitting.backscatter.ratios import (
    Windows,
    best_offset,
    corners_of,
    ratios,
    ratios_and_jacobian,
    window_for,
    with_room,
)
from udccal.fitting.backscatter.rules import BackscatterRules
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
class SampleErrors:
    """Errors of samples as a function of the parameters: windows on the panel stay where they are."""

    template: Backscatter
    samples: Samples
    weight: PerShot
    at: Windows
    logs: Float[np.ndarray, "n 3 pictures window2"]

    @classmethod
    def of(
        cls,
        template: Backscatter,
        samples: Samples,
        weight: PerShot,
        corner: Int[np.ndarray, "n 2"],
    ) -> SampleErrors:
        """With windows from these corners on."""
        at = Windows.at(template.window, samples.rays, corner, samples.shown)
        return cls(template, samples, weight, at, at.logs(samples.shown))

    def ratios(self, x: Vector) -> tuple[PerShot, Float[np.ndarray, "18 shots 3 n"]]:
        """Light over that of white, and its derivatives by the solver's coordinates."""
        ratio, jacobian = ratios_and_jacobian(self.template, linear_of(x), self.at, self.logs)
        return of_all_shots(ratio, 1.0), of_all_shots(jacobian * linear_slope(x)[:, None, None, None], 0.0)

    def __call__(self, x: Vector) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]:
        """Whitened errors, mask and dark at their best, and their Jacobian."""
        ratio, of_ratio = self.ratios(x)
        best = Profile.of(ratio, self.samples, self.weight)
        errors = best.errors(ratio, self.samples) * self.weight
        return errors.ravel(), best.jacobian(of_ratio).reshape(len(x), -1).T


@final
@dataclass(frozen=True)
class MostProbable:
    """The most probable parameters; ``cov`` is 0 for those that are held, ``cost`` holds what the prior adds."""

    x: Vector
    cov: Float[np.ndarray, "18 18"]
    cost: float
    converged: bool
    iterations: int


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
    errors_at: ErrorsAt,
    start: Vector,
    free: Bool[np.ndarray, "18"],
    prior: Prior,
    rules: SolverRules | None = None,
) -> MostProbable:
    """Where errors and prior together are least, over the free parameters."""
    problem = _Free(errors_at, free, Prior(prior.mean[free], prior.root[:, free]))
    found, cov = minimise(problem, start, rules), np.zeros((len(free), len(free)))
    cost = found.equations.cost
    if np.isfinite(cost):
        cov[np.ix_(free, free)] = found.equations.cov()
    return MostProbable(found.place, cov, cost, found.converged, found.iterations)


@final
@dataclass(frozen=True)
class Fitted:
    """Parameters and what follows from them at some positions; ``errors`` are measured less modelled rates."""

    found: MostProbable
    corner: Int[np.ndarray, "n 2"]
    ratio: PerShot
    mask: PerBin
    errors: PerShot
    weight: PerShot

    @classmethod
    def of(
        cls, found: MostProbable, corner: Int[np.ndarray, "n 2"], ratio: PerShot, samples: Samples, weight: PerShot
    ) -> Fitted:
        """With mask and dark at their best."""
        best = Profile.of(ratio, samples, weight)
        return cls(found, corner, ratio, best.mask, best.errors(ratio, samples), weight)

    def reweighed(self, samples: Samples, weight: PerShot) -> Fitted:
        """The same parameters at other weights."""
        return Fitted.of(self.found, self.corner, self.ratio, samples, weight)

    @property
    def light(self) -> PerShot:
        """Modelled light, the dark signal left out."""
        return self.mask * self.ratio

    @property
    def z(self) -> PerShot:
        """Errors in units of their sigma, 0 where not used."""
        return self.errors * self.weight

    @property
    def chi2(self) -> float:
        """The prior left out."""
        return float((self.z**2).sum())

    @property
    def used(self) -> Bool[np.ndarray, "shots 3 n"]:
        """Samples that count, dark left out."""
        return np.concatenate([self.weight[:-1] > 0, np.zeros((1, *self.mask.shape), dtype=bool)])


@final
@dataclass(frozen=True)
class Problem:
    """What all orders share; ``flat`` are the grid indices of the positions."""

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
        """Samples at positions spread over the sensor, with a start found by scanning."""
        rules, step, prior = rules or BackscatterRules(), grid_step(rig), prior_of(rig)
        rays, flat = sampled_rays(geometry, rig, step, rules.positions)
        # The mask comes out of the likelihood; the template's is of no size.
        template = nominal_backscatter(geometry, rig, np.zeros((3, 1, 1)), step, window=1)
        template = replace(template, window=window_for(template, linear_of(prior.mean), rays, rules.slack_px))
        samples = Samples.at(data, rays, flat, data.pictures)
        weight, start = samples.first_weights(), prior.mean.copy()
        lit = samples.excess[0] * weight[0] > 1.0
        white = np.where(lit, samples.excess[0], 1.0)
        ratio, weight = (np.where(lit, part, 0.0)[1:-1] for part in (samples.excess / white, weight * white))
        theta = linear_of(TWO_PLANES.without_crosstalk().start(prior.mean, prior))
        start[OFFSET] = best_offset(template, theta, rays, samples.shown, ratio, weight, offset_reach_px(rig))
        return cls(template, samples, flat, prior, start, rules)

    def solved(self, order: Order, x: Vector, weight: PerShot) -> Fitted:
        """The most probable parameters of an order at given weights, from ``x`` on."""
        start = order.start(x, self.prior)
        corner = corners_of(self.template, linear_of(start), self.samples.rays)
        errors_at = SampleErrors.of(self.template, self.samples, weight, corner)
        found = most_probable(errors_at, start, order.free, self.prior, self.rules.solver)
        ratio = of_all_shots(ratios(self.template, linear_of(found.x), errors_at.at, self.samples.shown), 1.0)
        return Fitted.of(found, corner, ratio, self.samples, weight)

    def with_room(self, x: Vector) -> Problem:
        """With windows that hold the footprints of these parameters."""
        rules = self.rules
        wider = with_room(self.template, linear_of(x), self.samples.rays, rules.slack_px, rules.most_wider)
        return replace(self, template=wider)
