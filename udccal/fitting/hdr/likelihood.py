"""The likelihood of one pixel's bracket, for a block of pixels in one compiled pass.

Samples below the clipping level are normal with the noise model's variance at the *merged* rate; samples at or above
it tell only that they are so (censored). The score in the rate r of a sample of exposure t, mean m = (r + dark) t and
variance v is therefore

    t (x - m) / v            below the level,
    t h(z) / sqrt(v)         at or above it,   z = (level - m) / sqrt(v),

with h the inverse Mills ratio of the normal distribution.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt16

from udccal.models.arrays import Arrayish

_TINY = 1e-30


@final
@dataclass(frozen=True)
class HdrRules:
    """The constants of a merge.

    Attributes:
        open_rounds, all_rounds: of Newton's method with the open samples only, then with the clipped ones too. More
            move no pixel by 1 % of its sigma.
        believed_sigma: a sample that the others of its pixel put farther off is a hit, no light, be it clipped or not.
        margin_sigma: a full well holds its charge before the dark noise is added: so far below it, no sample is full.
        least_variance: below zero rate the variance goes on falling, down to this part of that in the dark, so that
            the estimate stays unbiased there.
        frame_off, frame_sigma: a frame whose light is off by more than both is left out.
        frame_pixels: that a frame is judged by, at most.
        frame_least_pixels, frame_snr: and at least, of so much light over noise each.
        least_to_judge: samples of a pixel that hits and frames are judged by.
    """

    open_rounds: int = 1
    all_rounds: int = 2
    believed_sigma: float = 6.0
    margin_sigma: float = 6.0
    least_variance: float = 0.25
    frame_off: float = 0.02
    frame_sigma: float = 5.0
    frame_pixels: int = 20_000
    frame_least_pixels: int = 8
    frame_snr: float = 10.0
    least_to_judge: int = 3


class SensorNumbers(eqx.Module):
    """What the likelihood needs of the noise model, in electrons; single precision."""

    black_DN: Float[Arrayish, ""]
    e_per_DN: Float[Arrayish, ""]
    dark_e_per_s: Float[Arrayish, ""]
    floor_e2: Float[Arrayish, ""]
    level_e: Float[Arrayish, ""]


class BlockMerge(eqx.Module):
    """Of every pixel: rate and sigma in e-/s, open samples, and the worst sample with its squared deviation in sigma.

    The deviation is that from the rate that the other samples give (leave one out).
    """

    rate: Float[Arrayish, " pixels"]
    sigma: Float[Arrayish, " pixels"]
    used: Int[Arrayish, " pixels"]
    worst: Int[Arrayish, " pixels"]
    deviation2: Float[Arrayish, " pixels"]


def _mills(z: Float[Array, " pixels"]) -> Float[Array, " pixels"]:
    """Density over upper tail of the normal distribution; Abramowitz and Stegun 7.1.26 for the tail, 1e-3 up to 5."""
    t = 1 / (1 + 0.23164189 * jnp.abs(z))
    tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
    bell = jnp.exp(-0.5 * z * z)
    return jnp.where(z >= 0, 0.79788456 / tail, 0.39894228 * bell / (1 - 0.5 * tail * bell))


@functools.partial(jax.jit, static_argnames="rules")
def merge_block(
    frames: UInt16[Array, "n pixels"],
    times: Float[Array, " n"],
    sensor: SensorNumbers,
    left_out: Bool[Array, "n pixels"] | None,
    rules: HdrRules,
) -> BlockMerge:
    """Maximum-likelihood rates. Loops over samples are written out: a pixel stays in the processor's registers."""
    count = len(frames)
    light = [(frames[i].astype(jnp.float32) - sensor.black_DN) * sensor.e_per_DN for i in range(count)]
    everywhere = jnp.ones(frames.shape[1:], bool)
    allowed = [everywhere if left_out is None else ~left_out[i] for i in range(count)]
    is_open = [(x < sensor.level_e) & a for x, a in zip(light, allowed, strict=True)]
    time_open = sum(jnp.where(o, times[i], 0.0) for i, o in enumerate(is_open))
    total = sum(jnp.where(o, light[i] - sensor.dark_e_per_s * times[i], 0.0) for i, o in enumerate(is_open))
    rate = total / jnp.maximum(time_open, _TINY)
    for k in range(rules.open_rounds + rules.all_rounds):
        score, information = jnp.zeros_like(rate), jnp.zeros_like(rate)
        for i in range(count):
            mean, variance = _expected(rate, times[i], sensor, rules)
            slope = times[i] / variance
            s, own = jnp.where(is_open[i], slope * (light[i] - mean), 0.0), jnp.where(is_open[i], slope * times[i], 0.0)
            if k >= rules.open_rounds:
                z = (sensor.level_e - mean) * jax.lax.rsqrt(variance)
                believed = allowed[i] & ~is_open[i] & (z < rules.believed_sigma)
                ratio = _mills(z)
                s = jnp.where(believed, times[i] * jax.lax.rsqrt(variance) * ratio, s)
                own = jnp.where(believed, slope * times[i] * ratio * (ratio - z), own)
            score, information = score + s, information + own
        rate = rate + score / jnp.maximum(information, _TINY)
    worst, deviation2 = _worst(light, is_open, allowed, rate, information, times, sensor, rules)
    used = sum(o.astype(jnp.int32) for o in is_open)
    return BlockMerge(rate, jax.lax.rsqrt(jnp.maximum(information, _TINY)), used, worst, deviation2)


def _expected(
    rate: Float[Array, " pixels"], time: Float[Array, ""], sensor: SensorNumbers, rules: HdrRules
) -> tuple[Float[Array, " pixels"], Float[Array, " pixels"]]:
    mean = (rate + sensor.dark_e_per_s) * time
    return mean, jnp.maximum(mean + sensor.floor_e2, rules.least_variance * sensor.floor_e2)


def _worst(
    light: list[Float[Array, " pixels"]],
    is_open: list[Bool[Array, " pixels"]],
    allowed: list[Bool[Array, " pixels"]],
    rate: Float[Array, " pixels"],
    information: Float[Array, " pixels"],
    times: Float[Array, " n"],
    sensor: SensorNumbers,
    rules: HdrRules,
) -> tuple[Int[Array, " pixels"], Float[Array, " pixels"]]:
    worst, largest = jnp.zeros(rate.shape, jnp.int32), jnp.zeros_like(rate)
    for i, x in enumerate(light):
        mean, variance = _expected(rate, times[i], sensor, rules)
        share = times[i] ** 2 / (variance * jnp.maximum(information, _TINY))
        # Clipped although the others promise far less: how far, at least.
        beyond = jnp.where(is_open[i], x - mean, jnp.maximum(sensor.level_e - mean, 0.0))
        own = beyond**2 / variance / jnp.where(is_open[i], jnp.maximum(1 - share, 1e-3), 1.0)
        own = jnp.where(allowed[i], own, 0.0)
        worst, largest = jnp.where(own > largest, i, worst), jnp.maximum(own, largest)
    return worst, largest
