"""The likelihood of one pixel's bracket, for a block of pixels in one compiled pass.

Samples below the clipping level are normal with the noise model's variance at the *merged* rate. Samples at or above
it are censored: only that is known of them. The score in the rate r of a sample of exposure t, mean m = (r + dark) t
and variance v is therefore

    t (x - m) / v            below the level,
    t h(z) / sqrt(v)         at or above it,   z = (level - m) / sqrt(v),

with h the inverse Mills ratio of the normal distribution.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt16

from udccal.models.arrays import Arrayish

# Rounds with the unclipped samples only, then with the clipped ones too. More move no pixel by 1 % of its sigma.
_OPEN_ROUNDS, _ALL_ROUNDS = 1, 2
# Below zero rate the variance goes on falling, so that the estimate stays unbiased in the dark, down to this part.
_LEAST_VARIANCE = 0.25
_TINY = 1e-30


class SensorNumbers(eqx.Module):
    """The numbers of the noise model that the likelihood uses, in electrons; single precision."""

    black_DN: Float[Arrayish, ""]
    e_per_DN: Float[Arrayish, ""]
    dark_e_per_s: Float[Arrayish, ""]
    floor_e2: Float[Arrayish, ""]
    level_e: Float[Arrayish, ""]


class BlockMerge(eqx.Module):
    """Rate and sigma of every pixel in e-/s, its number of unclipped samples, and its worst sample.

    ``deviation2`` is that sample's squared deviation, in sigma, from the rate that the others give (leave one out).
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


@functools.partial(jax.jit, static_argnames="believed_sigma")
def merge_block(
    frames: UInt16[Array, "n pixels"],
    times: Float[Array, " n"],
    sensor: SensorNumbers,
    left_out: Bool[Array, "n pixels"] | None,
    believed_sigma: float,
) -> BlockMerge:
    """Maximum-likelihood rates. Loops over samples are unrolled: a pixel stays in the processor's registers."""
    count = len(frames)
    light = [(frames[i].astype(jnp.float32) - sensor.black_DN) * sensor.e_per_DN for i in range(count)]
    everywhere = jnp.ones(frames.shape[1:], bool)
    allowed = [everywhere if left_out is None else ~left_out[i] for i in range(count)]
    is_open = [(x < sensor.level_e) & a for x, a in zip(light, allowed, strict=True)]
    time_open = sum(jnp.where(o, times[i], 0.0) for i, o in enumerate(is_open))
    total = sum(jnp.where(o, light[i] - sensor.dark_e_per_s * times[i], 0.0) for i, o in enumerate(is_open))
    rate = total / jnp.maximum(time_open, _TINY)
    for k in range(_OPEN_ROUNDS + _ALL_ROUNDS):
        score, information = jnp.zeros_like(rate), jnp.zeros_like(rate)
        for i in range(count):
            mean, variance = _expected(rate, times[i], sensor)
            slope = times[i] / variance
            s, own = jnp.where(is_open[i], slope * (light[i] - mean), 0.0), jnp.where(is_open[i], slope * times[i], 0.0)
            if k >= _OPEN_ROUNDS:
                z = (sensor.level_e - mean) * jax.lax.rsqrt(variance)
                believed = allowed[i] & ~is_open[i] & (z < believed_sigma)
                ratio = _mills(z)
                s = jnp.where(believed, times[i] * jax.lax.rsqrt(variance) * ratio, s)
                own = jnp.where(believed, slope * times[i] * ratio * (ratio - z), own)
            score, information = score + s, information + own
        rate = rate + score / jnp.maximum(information, _TINY)
    worst, deviation2 = jnp.zeros(rate.shape, jnp.int32), jnp.zeros_like(rate)
    for i in range(count):
        mean, variance = _expected(rate, times[i], sensor)
        leverage = times[i] ** 2 / (variance * jnp.maximum(information, _TINY))
        # The least deviation of a sample that is clipped although the others give a far lower rate.
        beyond = jnp.where(is_open[i], light[i] - mean, jnp.maximum(sensor.level_e - mean, 0.0))
        own = beyond**2 / variance / jnp.where(is_open[i], jnp.maximum(1 - leverage, 1e-3), 1.0)
        own = jnp.where(allowed[i], own, 0.0)
        worst, deviation2 = jnp.where(own > deviation2, i, worst), jnp.maximum(own, deviation2)
    used = sum(o.astype(jnp.int32) for o in is_open)
    return BlockMerge(rate, jax.lax.rsqrt(jnp.maximum(information, _TINY)), used, worst, deviation2)


def _expected(
    rate: Float[Array, " pixels"], time: Float[Array, ""], sensor: SensorNumbers
) -> tuple[Float[Array, " pixels"], Float[Array, " pixels"]]:
    mean = (rate + sensor.dark_e_per_s) * time
    return mean, jnp.maximum(mean + sensor.floor_e2, _LEAST_VARIANCE * sensor.floor_e2)
