"""A small convolutional network that takes out what the linear filter leaves: noise, and detail it does not know.

A linear filter knows a scene's spectrum; a network learned from pictures knows edges. It sees the picture of the tier
``balanced``, to which it adds what it finds, two filtered pictures, one at the strength that the tile chose and a
sharper one, and how much noise the filter leaves in each band. It has no biases, so that it commutes with a change of
scale (Mohan et al., "Robust and interpretable blind image denoising via bias-free convolutional neural networks", ICLR
2020): light, exposure and gain do not matter. Pictures are taken apart into their 2 x 2 places first (Zhang, Zuo and
Zhang, "FFDNet", IEEE Trans. Image Processing 27, 2018), and a second level works at a quarter of the resolution.

``make network`` trains it on drawn shapes and photographs, blurred and filtered as restoration does.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from udccal.restoration.scene_prior import STRENGTHS
from udccal.restoration.shrink import interpolated
from udccal.restoration.tiles import TileLayout

# Planes of a picture, and of noise: bands at which the filter's noise is told.
COLOURS, BANDS = 3, 12
_PLACES = 4
# Channels that the network is given: three pictures by place, and the noise.
INPUTS = 3 * COLOURS * _PLACES + BANDS
# The sharper picture has the prior's strength times this.
SHARPER = np.float32(16)
# Detail is what differs from the mean over this many px.
DETAIL_PX = (31, 31)
# Rows that the network is given at once, and the coarse level's cell.
_BLOCK_ROWS, CELL_PX = 256, 4
# Ways round in which a picture can be shown: steps through its rows and columns.
WAYS = ((1, 1), (-1, -1), (1, -1), (-1, 1))
# Channels at half and at a quarter of the resolution, and residual blocks there.
_CHANNELS, BLOCKS = {"fine": 64, "coarse": 96}, {"fine": 3, "coarse": 4}
# How far the network looks: two convolutions a block, one before and one after all, and a cell.
REACH_PX = 2 * CELL_PX * BLOCKS["coarse"] + 2 * (2 * BLOCKS["fine"] + 2) + CELL_PX

WEIGHTS_FILE = Path(__file__).with_name("network.npz")

Weights = dict[str, Array]


def details(
    balanced: Float32[np.ndarray, "rows columns 3"],
    chosen: Float32[np.ndarray, "rows columns 3"],
    sharp: Float32[np.ndarray, "rows columns 3"],
    scale: Float32[np.ndarray, "*rows_columns 3"],
) -> Float32[np.ndarray, "rows columns 9"]:
    """Return what the network sees of three pictures, in units of the samples' noise ``scale``."""
    first = balanced / scale
    first -= cv2.blur(first, DETAIL_PX, borderType=cv2.BORDER_REFLECT_101)
    return np.concatenate([first, (chosen - balanced) / scale, (sharp - chosen) / scale], axis=-1)


def noise_planes(
    variance: Float32[np.ndarray, "tiles 3 levels bands"],
    noise_e: Float32[np.ndarray, "tiles 3"],
    local_variance_e2: Float32[np.ndarray, "rows columns"],
    layout: TileLayout,
) -> Float32[np.ndarray, "half_rows half_columns 12"]:
    """Return sigma of the grey noise that the filter leaves in each band, at half of the resolution.

    Arguments are those of ``shrink.shrunk``; the unit is the noise of a sample.
    """
    rows, columns = (-(-count // 2) for count in local_variance_e2.shape)
    brightness = local_variance_e2 / interpolated(layout, layout.by_place(np.mean(noise_e**2, axis=1, keepdims=True)))
    half = np.sqrt(cv2.resize(brightness, (columns, rows), interpolation=cv2.INTER_AREA))
    sigma = interpolated(layout, layout.by_place(np.sqrt(variance[:, 0]).reshape(len(variance), -1)), step=2)
    return sigma * half[..., None]


def sharper(strengths: Float32[np.ndarray, " tiles"]) -> Float32[np.ndarray, " tiles"]:
    """Return the strengths at which tiles are filtered a second time, for the network, given those that they chose."""
    return np.minimum(strengths * SHARPER, STRENGTHS[-1])


def refined(
    balanced: Float32[np.ndarray, "rows columns 3"],
    chosen: Float32[np.ndarray, "rows columns 3"],
    sharp: Float32[np.ndarray, "rows columns 3"],
    noise_e: Float32[np.ndarray, "tiles 3"],
    local_variance_e2: Float32[np.ndarray, "rows columns"],
    variance: Float32[np.ndarray, "tiles 3 levels bands"],
    layout: TileLayout,
    views: int,
) -> Float32[np.ndarray, "rows columns 3"]:
    """Return the picture of the tier ``balanced`` with what the network adds to it.

    Args:
        balanced: the picture of that tier. chosen: as filtered at the strengths that tiles chose. sharp: at
            ``sharper`` ones.
        noise_e, local_variance_e2, variance, layout: as for ``shrink.shrunk``.
        views: as for ``corrected``.
    """
    scale = interpolated(layout, layout.by_place(noise_e))
    return corrected(balanced, chosen, sharp, scale, noise_planes(variance, noise_e, local_variance_e2, layout), views)


def corrected(
    balanced: Float32[np.ndarray, "rows columns 3"],
    chosen: Float32[np.ndarray, "rows columns 3"],
    sharp: Float32[np.ndarray, "rows columns 3"],
    scale: Float32[np.ndarray, "rows columns 3"],
    noise: Float32[np.ndarray, "half_rows half_columns 12"],
    views: int,
) -> Float32[np.ndarray, "rows columns 3"]:
    """Return the picture of the tier ``balanced`` with what the network adds to it, in the unit of the pictures.

    Args:
        balanced, chosen, sharp: as for ``refined``.
        scale: noise of a sample of each colour. noise: of each band, in units of ``scale`` (``noise_planes``).
        views: ways round in which the network sees the picture, 1 to 4; what it finds is averaged. Its errors differ
            with them (Timofte, Rothe and Van Gool, "Seven ways to improve example-based single image super
            resolution", CVPR 2016, section 3.6).
    """
    rows, columns = balanced.shape[:2]
    weights, detail = network_weights(), details(balanced, chosen, sharp, scale)
    count = -(-rows // _BLOCK_ROWS)
    # Blocks of one shape are compiled once; what surrounds each is as far as the network looks.
    down = (REACH_PX, REACH_PX + count * _BLOCK_ROWS - rows)
    across = (REACH_PX, REACH_PX + -columns % CELL_PX)
    detail = np.pad(detail, (down, across, (0, 0)), mode="symmetric")
    noise = np.pad(noise, (*half_pads((rows, columns), (down, across), noise.shape[:2]), (0, 0)), mode="edge")
    result = np.empty_like(balanced)
    for top in range(0, rows, _BLOCK_ROWS):
        bottom = top + _BLOCK_ROWS + 2 * REACH_PX
        found = _mean(weights, detail[top:bottom], noise[top // 2 : bottom // 2], views)
        inner = found[REACH_PX : REACH_PX + min(_BLOCK_ROWS, rows - top), REACH_PX : REACH_PX + columns]
        result[top : top + _BLOCK_ROWS] = inner
    result *= scale
    result += balanced
    return result


def half_pads(size: tuple[int, ...], pads: Sequence[tuple[int, int]], half: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return by how much planes of the size ``half`` are padded where a picture of a ``size`` is, by ``pads``."""
    return [
        (before // 2, (before + count + after) // 2 - before // 2 - of_half)
        for count, (before, after), of_half in zip(size, pads, half, strict=True)
    ]


def _mean(
    weights: Weights,
    detail: Float32[np.ndarray, "rows columns 9"],
    noise: Float32[np.ndarray, "half_rows half_columns 12"],
    views: int,
) -> Float32[np.ndarray, "rows columns 3"]:
    """Return the mean of what the network finds when it sees a block ``views`` ways round."""
    total = np.zeros((*detail.shape[:2], COLOURS), np.float32)
    for down, across in WAYS[:views]:
        shown = (np.ascontiguousarray(planes[None, ::down, ::across]) for planes in (detail, noise))
        total += np.asarray(_compiled(weights, *shown))[0, ::down, ::across]
    return total / np.float32(views)


@functools.cache
def network_weights() -> Weights:
    """Read the weights that ship with udccal."""
    with np.load(WEIGHTS_FILE, allow_pickle=False) as stored:
        return {name: jnp.asarray(stored[name], jnp.float32) for name in shapes()}


def shapes() -> dict[str, tuple[int, int, int, int]]:
    """Return the shape of each kernel: rows, columns, channels in, channels out."""
    fine, coarse = _CHANNELS["fine"], _CHANNELS["coarse"]
    found = {"in": (3, 3, INPUTS, fine), "down": (2, 2, fine, coarse), "up": (1, 1, coarse, 4 * fine)}
    for level, channels in _CHANNELS.items():
        for block in range(BLOCKS[level]):
            found |= {f"{level}{block}{half}": (3, 3, channels, channels) for half in "ab"}
    return found | {"out": (3, 3, fine, COLOURS * _PLACES)}


def correction(
    weights: Weights,
    detail: Float[Array, "tiles rows columns 9"],
    noise: Float[Array, "tiles half_rows half_columns 12"],
) -> Float[Array, "tiles rows columns 3"]:
    """Return what is to be added to the first picture.

    Args:
        weights: of the network.
        detail: of three pictures by channel (``details``).
        noise: sigma that the filter leaves in each band, at half of the resolution; in the same unit as ``detail``.
    """
    first = _convolved(jnp.concatenate([_apart(detail), noise], axis=-1), weights["in"])
    fine = _block(first, weights, "fine0")
    coarse = _convolved(fine, weights["down"], stride=2)
    for block in range(BLOCKS["coarse"]):
        coarse = _block(coarse, weights, f"coarse{block}")
    fine = fine + _together(_convolved(coarse, weights["up"]))
    for block in range(1, BLOCKS["fine"]):
        fine = _block(fine, weights, f"fine{block}")
    return _together(_convolved(jax.nn.relu(fine), weights["out"]))


def _block(planes: Float[Array, "n y x c"], weights: Weights, name: str) -> Float[Array, "n y x c"]:
    inner = jax.nn.relu(_convolved(jax.nn.relu(planes), weights[f"{name}a"]))
    return planes + _convolved(inner, weights[f"{name}b"])


def _convolved(
    planes: Float[Array, "n y x c"], kernel: Float[Array, "ky kx c d"], stride: int = 1
) -> Float[Array, "n y2 x2 d"]:
    order = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(planes, kernel, (stride, stride), "SAME", dimension_numbers=order)


def _apart(planes: Float[Array, "n y x c"]) -> Float[Array, "n y2 x2 c4"]:
    """Return the 2 x 2 places of a picture as channels."""
    n, y, x, c = planes.shape
    return planes.reshape(n, y // 2, 2, x // 2, 2, c).transpose(0, 1, 3, 2, 4, 5).reshape(n, y // 2, x // 2, 4 * c)


def _together(planes: Float[Array, "n y x c4"]) -> Float[Array, "n y2 x2 c"]:
    """Return pictures from the channels of their 2 x 2 places."""
    n, y, x, c = planes.shape
    apart = planes.reshape(n, y, x, 2, 2, c // 4).transpose(0, 1, 3, 2, 4, 5)
    return apart.reshape(n, 2 * y, 2 * x, c // 4)


_compiled = jax.jit(correction)
