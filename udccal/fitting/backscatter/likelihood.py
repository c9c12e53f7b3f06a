"""Likelihood of the backscatter term: every picture's light in every bin with its own variance.

Light of shot i at a position and colour is  y_i = m r_i + u_i d + noise: r_i is the picture's light over that of white
(1 for white itself, 0 for the dark frame), m the mask and d the dark signal there, u_i the dark frame's exposure over
the shot's. m and d stand in no prior and enter linearly: they are profiled out exactly, bin by bin, so that the noise
of white and dark, which all pictures of a bin share, is weighed as it should be. Variances are of the model, shot noise
and what is left in the dark, plus (e m)^2 for what the model does not describe, e the model error as a share of white.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.backscatter.data import BackscatterData
from udccal.fitting.backscatter.parameters import linear_of, linear_slope
from udccal.fitting.backscatter.ratios import Pictures, Windows, ratios, ratios_and_jacobian
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import Blocks, SolverRules, Step, minimise
from udccal.models.backscatter import Backscatter
from udccal.numerics import in_float64

# Variance of a bin's count is never below this many e-^2: a black picture in a camera without read noise.
LEAST_VARIANCE = 1 / 12

# Parameters in the solver's coordinates to whitened errors and their Jacobian.
ErrorsAt = Callable[[Float[np.ndarray, "18"]], tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]]


@final
@dataclass(frozen=True)
class Samples:
    """Light at some positions; white comes first among the shots, and dark last.

    Attributes:
        rays: of the positions, in panel coordinates.
        light: rates in e-/s above the black level.
        shot: variance per rate, (e-/s)^2 per e-/s; also the rate of one electron in the bin.
        rest: variance of light in the dark.
        usable: False where samples are clipped.
        exposure: that of the dark frame over that of each shot.
        shown: what the panel showed.
    """

    rays: Float[np.ndarray, "n 3"]
    light: Float[np.ndarray, "shots 3 n"]
    shot: Float[np.ndarray, "shots 3 n"]
    rest: Float[np.ndarray, "shots 3 n"]
    usable: Bool[np.ndarray, "shots 3 n"]
    exposure: Float[np.ndarray, " shots"]
    shown: Pictures

    @classmethod
    def at(
        cls, data: BackscatterData, rays: Float[np.ndarray, "n 3"], flat: Int[np.ndarray, " n"], shown: Pictures
    ) -> Samples:
        """At grid positions with these rays and flat indices."""
        shots = data.shots
        light, shot, rest, clipped = (
            part.reshape(*part.shape[:2], -1)[:, :, flat]
            for part in (shots.rate, shots.shot, shots.rest, shots.clipped)
        )
        usable = ~clipped
        usable[-1] = True
        return cls(rays, light, shot, rest, usable, shots.exposure_s[-1] / shots.exposure_s, shown)

    @property
    def excess(self) -> Float[np.ndarray, "shots 3 n"]:
        """Light above that of the dark frame, as measured."""
        return self.light - self.exposure[:, None, None] * self.light[-1]

    def variance(self, rate: Float[np.ndarray, "shots 3 n"]) -> Float[np.ndarray, "shots 3 n"]:
        """Of every sample by noise, at this light."""
        return np.maximum(self.shot * np.maximum(rate, 0.0) + self.rest, LEAST_VARIANCE * self.shot**2)

    def weights(
        self,
        rate: Float[np.ndarray, "shots 3 n"],
        mask: Float[np.ndarray, "3 n"],
        model_error: float,
        usable: Bool[np.ndarray, "shots 3 n"],
    ) -> Float[np.ndarray, "shots 3 n"]:
        """1 / sigma of every sample, 0 where not usable, at this light of this mask."""
        variance = self.variance(rate)
        # White is the mask by definition, dark has no light: the model takes no part in them.
        variance[1:-1] += (model_error * mask) ** 2
        return np.where(usable, 1 / np.sqrt(variance), 0.0)

    def first_weights(self) -> Float[np.ndarray, "shots 3 n"]:
        """Weights by what was measured, one electron on the safe side."""
        rate = np.maximum(self.excess, 0.0) + self.shot
        rate[-1] = 0.0
        return self.weights(rate, np.zeros(rate.shape[1:]), 0.0, self.usable)


def of_all_shots(pictures: Float[np.ndarray, "*k pictures 3 n"], white: float) -> Float[np.ndarray, "*k shots 3 n"]:
    """What is known of the pictures' ratios with that of white before it, and that of dark, which is 0, after it."""
    ends = np.zeros((*pictures.shape[:-3], 1, *pictures.shape[-2:]))
    return np.concatenate([ends + white, pictures, ends], axis=-3)


@final
@dataclass(frozen=True)
class Profile:
    """Mask and dark signal of every bin at their best for given ratios: weighted linear least squares.

    Attributes:
        mask, dark: e-/s.
        information: on the mask, the dark signal not being known.
        weight: 1 / sigma of the samples.
        by_mask, by_dark: the directions in whitened samples that mask and dark take up, at right angles, of length 1.
    """

    mask: Float[np.ndarray, "3 n"]
    dark: Float[np.ndarray, "3 n"]
    information: Float[np.ndarray, "3 n"]
    weight: Float[np.ndarray, "shots 3 n"]
    by_mask: Float[np.ndarray, "shots 3 n"]
    by_dark: Float[np.ndarray, "shots 3 n"]

    @classmethod
    def of(
        cls, ratio: Float[np.ndarray, "shots 3 n"], samples: Samples, weight: Float[np.ndarray, "shots 3 n"]
    ) -> Profile:
        """For ratios of all shots."""
        light, ratio, apart = samples.light * weight, ratio * weight, samples.exposure[:, None, None] * weight
        length = np.sqrt((apart**2).sum(axis=0))
        by_dark = apart / length
        across = ratio - by_dark * (by_dark * ratio).sum(axis=0)
        information = (across**2).sum(axis=0)
        known = information > 0
        by_mask = across / np.sqrt(np.where(known, information, 1.0))
        mask = np.where(known, (by_mask * light).sum(axis=0) / np.sqrt(np.where(known, information, 1.0)), 0.0)
        dark = (by_dark * (light - mask * ratio)).sum(axis=0) / length
        return cls(mask, dark, information, weight, by_mask, by_dark)

    def errors(self, ratio: Float[np.ndarray, "shots 3 n"], samples: Samples) -> Float[np.ndarray, "shots 3 n"]:
        """Measured less modelled rates."""
        return samples.light - self.mask * ratio - samples.exposure[:, None, None] * self.dark

    def jacobian(self, of_ratio: Float[np.ndarray, "k shots 3 n"]) -> Float[np.ndarray, "k shots 3 n"]:
        """Of the whitened errors, off what mask and dark can take up (Kaufman, BIT 15, 1975).

        Its square is the information of the profiled likelihood.
        """
        jacobian = -(self.mask * self.weight) * of_ratio
        for way in (self.by_dark, self.by_mask):
            jacobian -= way * np.einsum("scn,kscn->kcn", way, jacobian)[:, None]
        return jacobian

    def mask_jacobian(self, of_ratio: Float[np.ndarray, "k shots 3 n"]) -> Float[np.ndarray, "k 3 n"]:
        """How the mask follows the ratios, for the light that is expected; what noise adds is of second order."""
        along = np.einsum("scn,kscn->kcn", self.by_mask * self.weight, of_ratio)
        return -self.mask * along / np.sqrt(np.where(self.information > 0, self.information, 1.0))

    def light_variance(
        self,
        ratio: Float[np.ndarray, "shots 3 n"],
        of_ratio: Float[np.ndarray, "k shots 3 n"],
        cov: Float[np.ndarray, "k k"],
    ) -> Float[np.ndarray, "shots 3 n"]:
        """Of predicted light: the parameters' covariance, the mask's noise, and how the two hang together."""
        moves = self.mask * of_ratio + ratio * self.mask_jacobian(of_ratio)[:, None]
        by_parameters = np.einsum("kicn,kl,licn->icn", moves, cov, moves, optimize=True)
        return np.asarray(by_parameters + ratio**2 / np.maximum(self.information, 1e-30))


@final
@dataclass(frozen=True)
class SampleErrors:
    """Errors of samples as a function of the parameters: windows on the panel stay where they are."""

    template: Backscatter
    samples: Samples
    weight: Float[np.ndarray, "shots 3 n"]
    at: Windows
    logs: Float[np.ndarray, "n 3 pictures window2"]

    @classmethod
    def of(
        cls,
        template: Backscatter,
        samples: Samples,
        weight: Float[np.ndarray, "shots 3 n"],
        corner: Int[np.ndarray, "n 2"],
    ) -> SampleErrors:
        """With windows from these corners on."""
        at = Windows.at(template.window, samples.rays, corner, samples.shown)
        return cls(template, samples, weight, at, at.logs(samples.shown))

    def ratios(
        self, x: Float[np.ndarray, "18"]
    ) -> tuple[Float[np.ndarray, "shots 3 n"], Float[np.ndarray, "18 shots 3 n"]]:
        """Light over that of white, and its derivatives by the solver's coordinates."""
        ratio, jacobian = ratios_and_jacobian(self.template, linear_of(x), self.at, self.logs)
        return of_all_shots(ratio, 1.0), of_all_shots(jacobian * linear_slope(x)[:, None, None, None], 0.0)

    def __call__(self, x: Float[np.ndarray, "18"]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]:
        """Whitened errors, mask and dark at their best, and their Jacobian."""
        ratio, of_ratio = self.ratios(x)
        best = Profile.of(ratio, self.samples, self.weight)
        errors = best.errors(ratio, self.samples) * self.weight
        return errors.ravel(), best.jacobian(of_ratio).reshape(len(x), -1).T


@final
@dataclass(frozen=True)
class MostProbable:
    """The most probable parameters; ``cov`` is 0 for those that are held, ``cost`` holds what the prior adds."""

    x: Float[np.ndarray, "18"]
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

    def equations_at(self, place: Float[np.ndarray, "18"]) -> Blocks:
        errors, jacobian = self.errors_at(place)
        return Blocks.of_errors(errors, jacobian[:, self.free]).with_prior(self.prior, place[self.free])

    def moved(self, place: Float[np.ndarray, "18"], step: Step) -> Float[np.ndarray, "18"]:
        moved = place.copy()
        moved[self.free] += step.shared
        return moved


@in_float64
def most_probable(
    errors_at: ErrorsAt,
    start: Float[np.ndarray, "18"],
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
    """Parameters and what follows from them at some positions, for samples with these weights (0: not used).

    ``corner`` is of each position's window, ``errors`` are measured less modelled rates.
    """

    found: MostProbable
    corner: Int[np.ndarray, "n 2"]
    ratio: Float[np.ndarray, "shots 3 n"]
    mask: Float[np.ndarray, "3 n"]
    errors: Float[np.ndarray, "shots 3 n"]
    weight: Float[np.ndarray, "shots 3 n"]

    @classmethod
    def of(
        cls,
        template: Backscatter,
        samples: Samples,
        weight: Float[np.ndarray, "shots 3 n"],
        found: MostProbable,
        corner: Int[np.ndarray, "n 2"],
    ) -> Fitted:
        """With windows from these corners on."""
        at = Windows.at(template.window, samples.rays, corner, samples.shown)
        ratio = of_all_shots(ratios(template, linear_of(found.x), at, samples.shown), 1.0)
        return cls(found, corner, ratio, np.zeros(ratio.shape[1:]), ratio, weight).reweighed(samples, weight)

    def reweighed(self, samples: Samples, weight: Float[np.ndarray, "shots 3 n"]) -> Fitted:
        """The same parameters with mask and dark at their best at other weights."""
        best = Profile.of(self.ratio, samples, weight)
        return replace(self, mask=best.mask, errors=best.errors(self.ratio, samples), weight=weight)

    @property
    def light(self) -> Float[np.ndarray, "shots 3 n"]:
        """Modelled light, the dark signal left out."""
        return self.mask * self.ratio

    @property
    def z(self) -> Float[np.ndarray, "shots 3 n"]:
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
