"""The backscatter's most probable parameters at an order, by likelihood (``Profile``) and prior."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.backscatter.data import BackscatterData, Binned, Profile
from udccal.fitting.backscatter.model import (
    Moves,
    PerShot,
    Pictures,
    Rays,
    Shares,
    Usable,
    grid_step,
    ratios,
    ratios_and_jacobian,
    ratios_of,
    sampled_rays,
    window_for,
)
from udccal.fitting.backscatter.parameters import (
    OFFSET,
    BackscatterRules,
    ErrorsAt,
    MostProbable,
    Order,
    Vector,
    linear_of,
    linear_slope,
    most_probable,
    prior_of,
)
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.nominal import nominal_backscatter
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.rig import RigDescription

PerSample = Float[np.ndarray, " k"]


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
    def used(self) -> Usable:
        """Samples with a weight, without the dark frame's."""
        used = self.best.weight > 0
        used[-1] = False
        return used

    def squares(self, seen: Binned, used: Usable) -> tuple[PerSample, PerSample, PerSample]:
        """Return squared errors of some samples, their variance by noise, and that by a model error of 1."""
        unit = np.broadcast_to(self.best.mask**2, used.shape).copy()
        # White is the mask by definition, and dark has no light: neither has a model error.
        unit[[0, -1]] = 0.0
        return self.best.errors[used] ** 2, seen.variance(self.light)[used], unit[used]

    def dof(self, prior: Prior) -> float:
        """Return samples less one mask per bin (the dark signal has a sample of its own) less parameters."""
        # A parameter that its prior determines counts less than one.
        narrowed = np.where(self.order.free, np.diag(self.found.cov) / prior.sigma**2, 1.0)
        used = self.used
        # A dark frame that is left out has no sample for its dark signal.
        per_bin = 1 + ~(self.best.weight[-1] > 0)
        return max(float(used.sum() - (used.any(axis=0) * per_bin).sum() - np.maximum(1.0 - narrowed, 0.0).sum()), 1.0)


@final
@dataclass(frozen=True)
class Problem:
    """The common part of all orders; ``flat`` are the positions' grid indices, ``rays`` are in panel coordinates.

    White was seen at ``white`` times the brightness of the pictures, and ``seen`` has it at theirs.
    """

    template: Backscatter
    seen: Binned
    shown: Pictures
    rays: Rays
    flat: Int[np.ndarray, " n"]
    prior: Prior
    start: Vector
    rules: BackscatterRules
    white: float = 1.0

    @classmethod
    def of(
        cls, data: BackscatterData, geometry: Geometry, rig: RigDescription, rules: BackscatterRules | None = None
    ) -> Problem:
        """Take samples at positions spread over the sensor, and start at the best offset of whole panel pixels."""
        rules, step, prior = rules or BackscatterRules(), grid_step(rig), prior_of(rig)
        rays, flat = sampled_rays(geometry, rig, step, rules.positions)
        # The likelihood gives the mask; the template's has a single bin.
        template = nominal_backscatter(geometry, rig, np.zeros((3, 1, 1)), step, window=1)
        theta = linear_of(prior.mean)
        # A fit whose footprints are more than three times as wide as nominal ones has gone astray.
        template = replace(template, window=int(3.0 * window_for(template, theta, rays, 0.5)))
        seen, shown, start = data.shots.at(flat), data.pictures, prior.mean.copy()
        weight = seen.first_weights(seen.usable)
        shares, panel = Shares.of(template, theta, rays), shown.light(float(theta[0]))[0]

        def cost(offset: tuple[int, int]) -> float:
            # An offset of whole pixels leaves the shares as they are.
            moved = replace(shares, panel_px=shares.panel_px - offset)
            return Profile.of(seen, ratios_of(theta, moved, shown, panel), weight).chi2

        across, down = (range(-int(np.ceil(reach)), int(np.ceil(reach)) + 1) for reach in prior.sigma[OFFSET])
        start[OFFSET] = min(((x, y) for y in down for x in across), key=cost)
        return cls(template, seen, shown, rays, flat, prior, start, rules)

    def with_white(self, brightness: float) -> Problem:
        """Return the problem with white at the pictures' brightness, of which it had this part."""
        return replace(self, seen=self.seen.with_white(brightness), white=self.white * brightness)

    def solved(self, order: Order, x: Vector, weight: PerShot) -> Fitted:
        """Solve for the most probable parameters of an order at given weights, from ``x`` on."""
        start = order.start(x, self.prior)
        found = most_probable(self.errors_at(weight), start, order.free, self.prior)
        ratio = ratios(self.template, linear_of(found.x), self.rays, self.shown)
        return Fitted(order, found, ratio, Profile.of(self.seen, ratio, weight))

    def ratios(self, x: Vector) -> tuple[PerShot, Moves]:
        """Return light over that of white, and its derivatives by the solver's coordinates."""
        ratio, jacobian = ratios_and_jacobian(self.template, linear_of(x), self.rays, self.shown)
        return ratio, jacobian * linear_slope(x)[:, None, None, None]

    def linearised(self, fitted: Fitted) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]:
        """Return a fit's whitened errors and their Jacobian."""
        return self.errors_at(fitted.best.weight)(fitted.found.x)

    def errors_at(self, weight: PerShot) -> ErrorsAt:
        """Return a function for whitened errors, with the best mask and dark, and their Jacobian."""

        def of(x: Vector) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]:
            ratio, of_ratio = self.ratios(x)
            best = Profile.of(self.seen, ratio, weight)
            return best.z.ravel(), best.jacobian(of_ratio).reshape(len(x), -1).T

        return of
