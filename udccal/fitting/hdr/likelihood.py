"""The likelihood of one pixel's bracket, for a block of pixels at once, in NumPy or compiled.

Samples below the clipping level are normal with the noise model's variance at the *merged* rate. Samples at or above
it are censored: only that is known of them. The score in the rate r of a sample of exposure t, mean m = (r + dark) t
and variance v is therefore

    t (x - m) / v            below the level,
    t h(z) / sqrt(v)         at or above it,   z = (level - m) / sqrt(v),

with h the inverse Mills ratio of the normal distribution. Where a precise sample is as likely clipped as not, the
likeliest rate is too high by up to a third of its sigma: a low draw is measured well, a high one only by shorter
exposures. So the bias of first order in the information is taken off (Cox and Snell 1968, equation 20; Firth
1993). Where only shorter exposures measure, a low draw puts the likeliest rate at the level's edge, where curvature
counts the clipped sample as a measurement. Sigma is then the root mean square distance of the rates that the samples
allow (their posterior without a prior) from the stated one.

A pixel's own offset (DSNU) is the same in all its samples. It enters the rate's sigma and the deviation of a sample,
not the weights.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from types import ModuleType
from typing import Final, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from udccal.arguments import check_number, number_of
from udccal.errors import FitError
from udccal.fitting.hdr.clipped import TINY, PerPixel, PerSample, bias_by_information, mills, moments_above
from udccal.models.arrays import Arrayish
from udccal.models.noise import Noise, linear_signal

# Below zero rate the variance goes on falling, so that the estimate stays unbiased in the dark, down to this part.
_LEAST_VARIANCE = 0.25
# Numbers that a sensor may have: single precision holds their squares.
_POSSIBLE: Final = {
    "K_DN_per_e": (1e-4, 1e5),
    "black_DN": (-65536.0, 65536.0),
    "saturation_DN": (1.0, 2.0**20),
    "sigma_d_e": (0.0, 1e6),
    "q_DN": (1e-3, 65536.0),
    "dark_current_e_per_s": (-1e6, 1e8),
    "DSNU1288_e": (0.0, 1e6),
    "nonlinearity": (-0.25, 0.25),
}
# A dark signal below zero is a black level that moves with the exposure: by no more than this part of a full pixel.
_LEAST_DARK: Final = -0.01


@final
@dataclass(frozen=True)
class HdrRules:
    """The constants of a merge.

    Attributes:
        believed_sigma: a sample farther than this from the other samples of its pixel is a hit, clipped or not.
        margin_sigma: samples count as clipped from this many sigma of dark noise below saturation on.
        frame_off, frame_sigma: a frame is left out when its light is off by more than both (relative, and in sigma).
        least_to_judge: the fewest samples of a pixel for finding hits and testing frames.
        scatter_off: scatter of samples about their light, relative to the noise model's variance, that is too much.
        sure_electrons: electrons that a pixel's light is worth before the scatter about it is judged.
        black_off: error of the black level, in sigma of dark noise, that is too much.
        bend_off: part of the signal at saturation, missing against shorter exposures, that is too much.
        light_off: light of a frame that is off, in sigma of a full pixel, of which a note tells.
        least_codes: codes above black from which neighbouring samples are rounded up as often as down: their light
            differs by parts of a code, and its own noise smears the steps.
    """

    believed_sigma: float = 6.0
    margin_sigma: float = 6.0
    frame_off: float = 0.02
    frame_sigma: float = 5.0
    least_to_judge: int = 3
    scatter_off: float = 0.05
    sure_electrons: float = 100.0
    black_off: float = 0.1
    bend_off: float = 0.01
    light_off: float = 0.25
    least_codes: float = 2.0
    least_even: int = 64


class SensorNumbers(eqx.Module):
    """The numbers of the noise model, in electrons, single precision.

    ``rounding_e`` shifts dark samples at most. Below ``rounded_below_e`` it moves samples of a pixel alike; that is 0
    where noise smears the codes' steps.
    """

    black_DN: Float[Arrayish, ""]
    e_per_DN: Float[Arrayish, ""]
    dark_e_per_s: Float[Arrayish, ""]
    floor_e2: Float[Arrayish, ""]
    level_e: Float[Arrayish, ""]
    offset_e: Float[Arrayish, ""]
    rounding_e: Float[Arrayish, ""]
    rounded_below_e: Float[Arrayish, ""]
    bend_per_DN: Float[Arrayish, ""]

    @classmethod
    def of(cls, noise: Noise, unit_s: float, rules: HdrRules) -> SensorNumbers:
        """The numbers of a noise model, times in units of ``unit_s``."""
        found = {name: number_of(getattr(noise, name, None)) for name in _POSSIBLE}
        for name, number in found.items():
            check_number(number, f"a noise model whose {name} is a number", _POSSIBLE[name], "Fit the noise.", FitError)
        K, black, saturation, sigma_d, q, dark, offset, bent = (float(np.asarray(one)) for one in found.values())
        if not saturation > black:
            raise FitError(f"Expected saturation above black, found {saturation:g} and {black:g} DN. Fit the noise.")
        if dark * unit_s < _LEAST_DARK * (saturation - black) / K:
            all_e = f"{dark:g} e/s, which is {dark * unit_s:.3g} e in the longest exposure"
            raise FitError(f"Expected a dark current of about 0 or more, found {all_e}. Fit the noise.")
        # A sensor without any dark noise still has a least variance: the likelihood of its dark pixels stays finite.
        floor = max(sigma_d**2 + (q / K) ** 2 / 12.0, 1e-4)
        # The first harmonic of the codes' steps, as far as noise does not smear them.
        rounding = float(q / K / np.pi * np.exp(-2 * (np.pi * sigma_d * K / q) ** 2))
        below = rules.least_codes * q / K if rounding > rules.black_off * floor**0.5 else 0.0
        bend = bent / (saturation - black)
        level = linear_signal(saturation - black, bend) / K - rules.margin_sigma * floor**0.5
        return cls(black, 1 / K, dark * unit_s, floor, level, offset, rounding, below, bend)

    def electrons(self, codes: PerSample) -> PerSample:
        """Light of samples in e-, dark current included; the response's bend is taken out."""
        signal: PerSample = linear_signal(codes - self.black_DN, self.bend_per_DN)
        return signal * self.e_per_DN


class BlockMerge(eqx.Module):
    """Rate and sigma in e-/s, number of unclipped samples, worst sample, and the square of its deviation in sigma."""

    rate: PerPixel
    sigma: PerPixel
    used: Int[Arrayish, " pixels"]
    worst: Int[Arrayish, " pixels"]
    deviation2: PerPixel


def _upward_deviance(beyond: PerSample, mean: PerSample, variance: PerSample, xp: ModuleType) -> PerSample:
    """Deviance of scaled counts of this variance and skewness: few electrons scatter more upwards than downwards."""
    scale = xp.maximum(mean / variance, 0.03)
    relative = xp.maximum(beyond * scale / variance, 0)
    return 2 * variance / scale**2 * ((1 + relative) * xp.log1p(relative) - relative)


def merge_block(
    frames: UInt16[Arrayish, "n pixels"],
    times: Float[Arrayish, " n"],
    sensor: SensorNumbers,
    left_out: Bool[Arrayish, "n pixels"],
    believed_sigma: float,
    xp: ModuleType = np,
) -> BlockMerge:
    """Maximum-likelihood rates, computed by the functions of ``xp``, numpy or jax.numpy."""
    time = times[:, None]

    def expected(rate: PerPixel) -> tuple[PerSample, PerSample]:
        mean = (rate + sensor.dark_e_per_s) * time
        return mean, xp.maximum(mean + sensor.floor_e2, _LEAST_VARIANCE * sensor.floor_e2)

    light = sensor.electrons(frames.astype(np.float32))
    is_open, is_clipped = (light < sensor.level_e) & ~left_out, (light >= sensor.level_e) & ~left_out
    electrons = xp.where(is_open, light - sensor.dark_e_per_s * time, 0).sum(axis=0)
    rate = electrons / xp.maximum(xp.where(is_open, time, 0).sum(axis=0), TINY)
    # One round with the unclipped samples only, two with the clipped ones too: more move no pixel by 1 % of its sigma.
    for with_clipped in (False, True, True):
        mean, variance = expected(rate)
        slope = time / variance
        score, information = xp.where(is_open, slope * (light - mean), 0), xp.where(is_open, slope * time, 0)
        if with_clipped:
            z = (sensor.level_e - mean) / xp.sqrt(variance)
            # The rate that the unclipped samples give has its own error.
            known = information.sum(axis=0)
            apart = xp.sqrt(1 + xp.where(known > 0, slope * time / xp.maximum(known, TINY), 0))
            believed, (ratio, spread) = is_clipped & (z < believed_sigma * apart), mills(z, xp)
            score = xp.where(believed, time / xp.sqrt(variance) * ratio, score)
            information = xp.where(believed, slope * time * (1 - spread), information)
        total = xp.maximum(information.sum(axis=0), TINY)
        rate = rate + score.sum(axis=0) / total
    scale = xp.where(is_open | believed, time / xp.sqrt(variance), 0)
    # Where exposures lie so far apart that the first order is a sigma and more, it is no longer the bias.
    bias = xp.minimum(bias_by_information(z, ratio, scale, xp) / total, 1 / xp.sqrt(total))
    # Where noise makes the rate negative, samples scatter as without light, not as their weights say.
    stated = xp.maximum((information * variance / xp.maximum(variance, expected(0 * rate)[1])).sum(axis=0), TINY)
    mean, variance = expected(rate)
    # Below zero rate the rounds may not have settled: a sample's deviation is that from the rate of these weights.
    slope = xp.where(is_open, time / variance, 0)
    now = xp.maximum((slope * time).sum(axis=0), TINY)
    settled, share = (slope * (light - mean)).sum(axis=0) / now, time**2 / (variance * xp.maximum(total, now))
    left = xp.where(is_open, xp.maximum(1 - share, 1e-3), 1 + share)
    level = sensor.level_e / time - sensor.dark_e_per_s
    mean_above, spread2 = moments_above(believed, level, variance / time**2, rate + settled, 1 / now, xp)
    mean = mean + xp.where(is_clipped.any(axis=0), 0, settled) * time
    # The least deviation of a sample that is clipped although the others give a far lower rate.
    beyond = xp.where(is_open, light - mean, xp.maximum(sensor.level_e - mean, 0)) / xp.sqrt(left)
    # One sample alone may have made the rate so low that it seems to be known well: the others may give a higher one.
    mean = xp.maximum(mean, mean - (1 - left) / xp.sqrt(left) * beyond)
    variance = xp.maximum(variance, mean + sensor.floor_e2) + sensor.offset_e**2
    own = xp.where(left_out, 0, beyond**2 / variance)
    worst, used = own.argmax(axis=0), is_open.sum(axis=0, dtype=np.int32)
    fewer = xp.where(beyond > 0, xp.minimum(own, _upward_deviance(beyond, mean, variance, xp)), own)
    deviation2 = xp.take_along_axis(fewer, worst[None], axis=0)[0]
    offset = sensor.offset_e * slope.sum(axis=0) / now
    spread2 = xp.where(believed.any(axis=0), spread2 + (rate - bias - mean_above) ** 2, 1 / stated)
    return BlockMerge(rate - bias, xp.sqrt(spread2 + offset**2), used, worst, deviation2)


compiled_merge_block = jax.jit(functools.partial(merge_block, xp=jnp), static_argnames="believed_sigma")


_Some = Float[np.ndarray, "n some"]
_Used = Bool[np.ndarray, "n some"]


@final
@dataclass(frozen=True)
class Residuals:
    """Samples of some pixels in electrons: light less its mean, signal above dark and variance, by the merged light.

    ``weight`` is what each tells of its pixel's light, 0 for clipped ones; ``clear`` ones are clear of clipping.
    """

    times: Float[np.ndarray, "n 1"]
    errors: _Some
    mean: _Some
    signal: _Some
    variance: _Some
    weight: _Some
    clear: _Used

    def bright(self, sigmas: float) -> _Used:
        """The clear ones whose signal is more than so many of their sigmas."""
        return self.clear & (sigmas * np.sqrt(self.variance) < self.signal)

    def left(self, cause: Float[np.ndarray, "*k n some"], weight: _Some) -> Float[np.ndarray, "*k n some"]:
        """What of a deviation is left in the errors where each pixel's light, with these weights, follows it."""
        information = np.maximum((weight * self.times**2).sum(axis=0), 1e-30)
        followed = (weight * self.times * cause).sum(axis=-2, keepdims=True) / information
        left = cause - self.times * followed
        # Where the light follows it altogether, rounding leaves something.
        return np.where(np.abs(left) > 1e-9 * np.abs(cause), left, 0.0)

    def amounts(
        self, causes: Float[np.ndarray, "k n some"], weight: _Some, used: _Used, most_sigma: float
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """How much of some deviations the errors have together, by what is left of them; hits count as limits.

        The sigma of what these samples do not show is infinite.
        """
        sigma = np.sqrt(self.variance[used])
        errors = np.clip(self.errors[used] / sigma, -most_sigma, most_sigma)
        left = self.left(causes, weight)[:, used] / sigma
        size = np.maximum(np.linalg.norm(left, axis=1), 1e-30)
        left = left / size[:, None]
        # All frames together have the light of the pixels, which is not known otherwise.
        cov = np.linalg.pinv(left @ left.T, rcond=1e-9, hermitian=True)
        known = np.maximum(np.diag(cov), 0.0)
        return cov @ (left @ errors) / size, np.where(known > 0, np.sqrt(known) / size, np.inf)
