"""Noise taken out on a device: band by band as ``shrink`` does it, and by the network of the tier ``accurate``."""

from __future__ import annotations

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.fft import next_fast_len

from udccal.restoration.device.planes import Mosaic, box_mean, convolved, cut, joined, placing, resized
from udccal.restoration.network import CELL_PX, DETAIL_PX, REACH_PX, WAYS, Weights, correction, half_pads
from udccal.restoration.shrink import BANDS, LEVELS, MARGIN, OPPONENT, SMOOTH, WINDOW, Runs, hats, linear_weights
from udccal.restoration.tiles import TileLayout

Planes = Float[Array, "3 rows columns"]
# Sigma of a sample of each colour, a sample's variance over some px, that of unit noise in each band; e- and e-^2.
Noise = tuple[Float[Array, "tiles 3"], Mosaic, Float[Array, "tiles 3 levels bands"]]


def shrunk(picture: Planes, noise: Noise, layout: TileLayout) -> Planes:
    """Take noise out of a filtered picture. Arguments are those of ``shrink.shrunk``."""
    noise_e, local_e2, variance = noise
    scale = between(layout, noise_e)
    brightness = [local_e2 / jnp.mean(scale**2, axis=0)]
    for _ in range(1, LEVELS):
        brightness.append(halved(brightness[-1]))
    by_place = jnp.moveaxis(MARGIN * variance, 0, -1).reshape(3, LEVELS, BANDS, len(layout.tops), -1)
    # Products of matrices: XLA would compute what sums need anew for each of the three planes.
    opponent = jnp.einsum("ij,jyx->iyx", OPPONENT, picture / scale)
    calm = _level(opponent, by_place, brightness, layout)
    return jnp.einsum("ji,jyx->iyx", OPPONENT, calm) * scale


def _level(
    planes: Planes, noise: Float[Array, "3 _ _ _ _"], brightness: list[Array], layout: TileLayout, level: int = 0
) -> Planes:
    """Shrink the bands at this level, and at coarser ones by what they change."""
    down, across = convolved(planes, SMOOTH, -2), convolved(planes, SMOOTH, -1)
    smooth = convolved(down, SMOOTH, -1)
    shape, result = (planes.shape[1], planes.shape[2]), smooth
    for index, band in enumerate((down - smooth, across - smooth, planes - down - across + smooth)):
        energy = box_mean(band * band, WINDOW[0]) + 1e-20
        unexplained = 1 - _largest(noise[:, level, index], shape, layout, level) * brightness[level] / energy
        result += jnp.maximum(unexplained, 0) * band
    if level + 1 < LEVELS and min(shape) > 2 * len(SMOOTH):
        half = smooth[:, ::2, ::2]
        change = _level(half, noise, brightness, layout, level + 1) - half
        result += resized(change, shape, cv2.INTER_LINEAR)
    return result


def _largest(values: Float[Array, "3 down across"], shape: tuple[int, int], layout: TileLayout, level: int) -> Planes:
    """Return the value of each sample's tile; of two tiles, the larger one."""
    for axis, strips, count in zip((1, 2), layout.strips, shape, strict=True):
        runs = Runs.of(strips, count, 0.5**level)
        both = (jnp.take(values, np.repeat(of, runs.samples), axis=axis) for of in (runs.first, runs.last))
        values = jnp.maximum(*both)
    return values


def between(layout: TileLayout, values: Float[Array, "tiles planes"], step: int = 1) -> Float[Array, "planes _ _"]:
    """Interpolate values between the tiles' centres, as ``shrink.interpolated`` does."""
    down, across = (each.toarray() for each in hats(layout, step))
    return down @ values.T.reshape(-1, len(layout.tops), len(layout.lefts)) @ across.T


def halved(plane: Mosaic) -> Float[Array, "half_rows half_columns"]:
    """Return the mean of every 2 x 2 samples; of an odd number of samples, of as many more as are needed."""
    rows, columns = plane.shape
    return resized(plane, (-(-rows // 2), -(-columns // 2)), cv2.INTER_AREA)


def refined(weights: Weights, pictures: list[Planes], noise: Noise, layout: TileLayout, views: int) -> Planes:
    """Return the picture of the tier ``balanced`` with what the network adds, as ``network.refined`` does.

    Args:
        weights: of the network. pictures: of that tier, at the strengths that tiles chose, and at sharper ones.
        noise: as for ``shrunk``. layout: of the tiles. views: ways round in which the network sees a picture.
    """
    (balanced, chosen, sharp), (noise_e, local_e2, variance) = pictures, noise
    size, scale = balanced.shape[1:], between(layout, noise_e)
    first = balanced / scale
    first -= box_mean(first, DETAIL_PX[0])
    detail = jnp.concatenate([first, (chosen - balanced) / scale, (sharp - chosen) / scale])
    brightness = local_e2 / between(layout, jnp.mean(noise_e**2, axis=1, keepdims=True))[0]
    sigma = between(layout, jnp.sqrt(variance[:, 0].reshape(len(variance), -1)), step=2)
    left = sigma * jnp.sqrt(halved(brightness))
    pads = [(REACH_PX, REACH_PX + -count % CELL_PX) for count in size]
    detail = jnp.pad(detail, ((0, 0), *pads), mode="symmetric")
    left = jnp.pad(left, ((0, 0), *half_pads(size, pads, left.shape[1:])), mode="edge")
    ways = WAYS[:views]
    turned = (jnp.stack([jnp.moveaxis(each, 0, -1)[::y, ::x] for y, x in ways]) for each in (detail, left))
    mean = sum(one[::y, ::x] for one, (y, x) in zip(correction(weights, *turned), ways, strict=True)) / len(ways)
    inner = tuple(slice(REACH_PX, REACH_PX + count) for count in size)
    return balanced + jnp.moveaxis(mean[inner], -1, 0) * scale


def blurred(picture: Planes, kernels: Float[Array, "kernels 3 ky kx"], layout: TileLayout) -> Planes:
    """Blur a sharp picture as ``blur.blurred`` does, by the kernels of the layout, of odd size."""
    places, weights, blends, size = [], [], [], []
    for middles, count, samples in zip(layout.kernel_middles, layout.covered, kernels.shape[2:], strict=True):
        reach = samples // 2
        hat = linear_weights(middles, np.arange(-reach, count + reach))
        most = int(np.count_nonzero(hat, axis=0).max())
        at = np.minimum((hat > 0).argmax(axis=0), len(hat) - most)[:, None] + np.arange(most)
        places.append(np.pad(np.arange(count), reach, mode="symmetric")[at])
        weights.append(hat[at, np.arange(len(at))[:, None]])
        size.append(int(next_fast_len(most + 2 * reach, real=True)))
        blends.append(placing(at[:, 0] - 2 * reach, np.ones((len(at), size[-1]), np.float32), count))
    down, across = np.repeat(weights[0], len(weights[1]), axis=0), np.tile(weights[1], (len(weights[0]), 1))
    tiles = cut(picture, *places) * down[:, None, :, None] * across[:, None, None, :]
    spectrum = jnp.fft.rfft2(tiles, s=size) * jnp.fft.rfft2(kernels, s=size)
    return joined(jnp.fft.irfft2(spectrum, s=size), *blends)
