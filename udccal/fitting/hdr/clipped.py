"""What clipped samples say of a pixel's rate: "at least the level"."""

from __future__ import annotations

from types import ModuleType

from jaxtyping import Bool, Float

from udccal.models.arrays import Arrayish

PerSample = Float[Arrayish, "n pixels"]
PerPixel = Float[Arrayish, " pixels"]
TINY = 1e-30
_Values = Float[Arrayish, "*shape"]
_PEAK = 0.3989422804  # of the normal density


def mills(z: _Values, xp: ModuleType) -> tuple[_Values, _Values]:
    """Density over upper tail of the normal distribution, and the variance of that tail, to 1e-4 and 1e-2.

    It is that of Abramowitz and Stegun 7.1.26; from 2.5 on, their continued fraction 26.2.14.
    """
    t = 1 / (1 + 0.23164189 * abs(z))
    tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
    bell = xp.exp(-0.5 * z * z)
    near = xp.where(z >= 0, 0.79788456 / tail, 0.39894228 * bell / (1 - 0.5 * tail * bell))
    far = xp.maximum(z, 2.5)
    after = far + 2 / (far + 3 / (0.5 * far + xp.sqrt(0.25 * far * far + 4)))
    beyond = 1 / after
    ratio = xp.where(z > 2.5, far + beyond, near)
    return ratio, xp.where(z > 2.5, beyond * (after - far - beyond), 1 - near * (near - z))


def bias_by_information(z: PerSample, ratio: PerSample, scale: PerSample, xp: ModuleType) -> PerPixel:
    """Bias of the likeliest rate times its information; samples are censored at ``z`` sigma, ``scale`` is t / sigma.

    With U the score, it is -(E[U^3] + E[U U']) / 2 over the expected information, each a sum over the pixel's samples.
    """
    density = _PEAK * xp.exp(-0.5 * z * z)
    clipped = xp.where(z > -5, density / xp.maximum(ratio, TINY), 1.0)
    information = (scale**2 * (1 - clipped + density * (ratio - z))).sum(axis=0)
    return 0.5 * (scale**3 * density * (1 + z * (z - ratio))).sum(axis=0) / xp.maximum(information, TINY)


def moments_above(
    clipped: Bool[Arrayish, "n pixels"],
    level: Float[Arrayish, "n 1"],
    width2: PerSample,
    mean: PerPixel,
    spread2: PerPixel,
    xp: ModuleType,
) -> tuple[PerPixel, PerPixel]:
    """Mean and variance of rates that are known by open samples, once clipped ones say "at least the level".

    The likelihood of a clipped sample of this width is a normal distribution's integral: the moments of its product
    with a normal density have a closed form. Clipped samples count one after another.
    """
    for k in range(len(clipped)):
        both2 = spread2 + width2[k]
        ratio, left = mills((level[k] - mean) / xp.sqrt(both2), xp)
        mean = mean + xp.where(clipped[k], ratio * spread2 / xp.sqrt(both2), 0)
        spread2 = xp.where(clipped[k], spread2 * (1 - spread2 / both2 * (1 - left)), spread2)
    return mean, spread2
