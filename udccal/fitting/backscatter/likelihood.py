"""Likelihood of the backscatter term: every picture's light in every bin with its own variance.

Light of shot i at a position and colour is  y_i = m r_i + u_i d + noise: r_i is the picture's light over that of white
(1 for white itself, 0 for the dark frame), m the mask and d the dark signal there, u_i the dark frame's exposure over
the shot's. m and d stand in no prior and enter linearly: they are profiled out exactly, bin by bin, so that the noise
of white and dark, which all pictures of a bin share, is weighed as it should be. Variances are of the model, shot noise
and what is left in the dark, plus (e m)^2 for what the model does not describe, e the model error as a share of white.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.backscatter.data import BackscatterData
from udccal.fitting.backscatter.ratios import Pictures

# Variance of a bin's count is never below this many e-^2: a black picture in a camera without read noise.
LEAST_VARIANCE = 1 / 12

# By shot (white first, dark last), colour and position; by bin: colour and position.
PerShot = Float[np.ndarray, "shots 3 n"]
PerBin = Float[np.ndarray, "3 n"]


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
    light: PerShot
    shot: PerShot
    rest: PerShot
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
    def excess(self) -> PerShot:
        """Light above that of the dark frame, as measured."""
        return self.light - self.exposure[:, None, None] * self.light[-1]

    def variance(self, rate: PerShot) -> PerShot:
        """Of every sample by noise, at this light."""
        return np.maximum(self.shot * np.maximum(rate, 0.0) + self.rest, LEAST_VARIANCE * self.shot**2)

    def weights(
        self,
        rate: PerShot,
        mask: PerBin,
        model_error: float,
        usable: Bool[np.ndarray, "shots 3 n"],
    ) -> PerShot:
        """1 / sigma of every sample, 0 where not usable, at this light of this mask."""
        variance = self.variance(rate)
        # White is the mask by definition, dark has no light: the model takes no part in them.
        variance[1:-1] += (model_error * mask) ** 2
        return np.where(usable, 1 / np.sqrt(variance), 0.0)

    def first_weights(self) -> PerShot:
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

    mask: PerBin
    dark: PerBin
    information: PerBin
    weight: PerShot
    by_mask: PerShot
    by_dark: PerShot

    @classmethod
    def of(cls, ratio: PerShot, samples: Samples, weight: PerShot) -> Profile:
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

    def errors(self, ratio: PerShot, samples: Samples) -> PerShot:
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
        ratio: PerShot,
        of_ratio: Float[np.ndarray, "k shots 3 n"],
        cov: Float[np.ndarray, "k k"],
    ) -> PerShot:
        """Of predicted light: the parameters' covariance, the mask's noise, and how the two hang together."""
        moves = self.mask * of_ratio + ratio * self.mask_jacobian(of_ratio)[:, None]
        by_parameters = np.einsum("kicn,kl,licn->icn", moves, cov, moves, optimize=True)
        return np.asarray(by_parameters + ratio**2 / np.maximum(self.information, 1e-30))
