"""What OpenCV does to planes on a CPU, for arrays on a device; sites and tiles taken apart and put together.

Planes are the last two axes of an array. Borders are mirrored at the last sample, as BORDER_REFLECT_101 does.
"""

from __future__ import annotations

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, Integer, Shaped

from udccal.cfa import Cfa

Mosaic = Float[Array, "rows columns"]
Planes = Float[Array, "*n rows columns"]


def apart(mosaic: Shaped[Array, "*n rows columns"], cfa: Cfa) -> Shaped[Array, "*n sites _ _"]:
    """Return the samples of each site of a colour pattern as a plane of its own."""
    *n, rows, columns = mosaic.shape
    split = mosaic.reshape(*n, rows // cfa.rows, cfa.rows, columns // cfa.columns, cfa.columns)
    return jnp.moveaxis(split, (-3, -1), (-4, -3)).reshape(*n, -1, rows // cfa.rows, columns // cfa.columns)


def together(planes: Shaped[Array, "*n sites _ _"], cfa: Cfa) -> Shaped[Array, "*n rows columns"]:
    """Return the mosaic whose sites ``apart`` finds."""
    *n, _, rows, columns = planes.shape
    split = jnp.moveaxis(planes.reshape(*n, cfa.rows, cfa.columns, rows, columns), (-4, -3), (-3, -1))
    return split.reshape(*n, rows * cfa.rows, columns * cfa.columns)


def cut(
    planes: Float[Array, "*n rows columns"], down: Int[np.ndarray, "tiles_down y"], across: Int[np.ndarray, "_ x"]
) -> Float[Array, "tiles *n y x"]:
    """Return tiles, row by row, by the rows and columns that they take."""
    wide = jnp.take(jnp.take(planes, down.ravel(), axis=-2), across.ravel(), axis=-1)
    split = wide.reshape(*planes.shape[:-2], *down.shape, *across.shape)
    return jnp.moveaxis(split, (-4, -2), (0, 1)).reshape(-1, *planes.shape[:-2], down.shape[1], across.shape[1])


def joined(
    tiles: Float[Array, "tiles *n y x"], down: Float32[np.ndarray, "rows _"], across: Float32[np.ndarray, "columns _"]
) -> Float[Array, "*n rows columns"]:
    """Return the sum of tiles by the matrices of ``placing``."""
    _, *n, y, x = tiles.shape
    split = tiles.reshape(down.shape[1] // y, across.shape[1] // x, *n, y, x)
    planes = jnp.moveaxis(split, (0, 1), (-4, -2)).reshape(*n, down.shape[1], across.shape[1])
    return along(across, along(down, planes, -2), -1)


def placing(
    starts: Int[np.ndarray, " tiles"], weights: Float32[np.ndarray, "tiles samples"], count: int
) -> Float32[np.ndarray, "count tiles_and_samples"]:
    """Return the matrix that adds tiles along one axis of ``count`` samples, each from its start on, by its weights."""
    at = starts[:, None] + np.arange(weights.shape[1])
    inside = (at >= 0) & (at < count)
    matrix = np.zeros((count, at.size), np.float32)
    matrix[at[inside], np.flatnonzero(inside)] = weights[inside]
    return matrix


def convolved(planes: Planes, taps: Float32[np.ndarray, " taps"], axis: int) -> Planes:
    """Filter planes along one axis, -2 or -1; of an even number of taps, one more lies before the sample."""
    size, count = len(taps), planes.shape[axis]
    pads = [(0, 0)] * planes.ndim
    pads[axis] = (size // 2, size - 1 - size // 2)
    wide = jnp.pad(planes, pads, mode="reflect")
    taken = (jax.lax.slice_in_dim(wide, k, k + count, axis=axis % planes.ndim) for k in range(size))
    return sum(tap * part for tap, part in zip(taps, taken, strict=True))


def box_mean(planes: Planes, size: int) -> Planes:
    """Return the mean of ``size`` x ``size`` samples around each."""
    taps = np.full(size, 1 / size, np.float32)
    return convolved(convolved(planes, taps, -2), taps, -1)


def along(matrix: Float32[np.ndarray, "to of"], values: Float[Array, "*shape"], axis: int) -> Float[Array, "*other"]:
    """Multiply along one axis by a matrix; by gathers where it has at most 4 numbers beside 0 in a row."""
    most = int(np.count_nonzero(matrix, axis=1).max())
    if most > 4:
        return jnp.moveaxis(jnp.tensordot(matrix, values, (1, axis)), 0, axis)
    index = np.argsort(matrix == 0, axis=1, kind="stable")[:, :most]
    shape = [1] * values.ndim
    shape[axis] = len(matrix)
    weights = np.take_along_axis(matrix, index, axis=1).T
    return sum(jnp.take(values, at, axis=axis) * own.reshape(shape) for at, own in zip(index.T, weights, strict=True))


def resized(planes: Planes, size: tuple[int, int], interpolation: int) -> Float[Array, "*n new_rows new_columns"]:
    """Return planes of another ``size`` (rows, columns), by one of OpenCV's interpolations."""
    for axis, to in zip((-2, -1), size, strict=True):
        # What OpenCV makes of single samples along this axis.
        single = np.eye(planes.shape[axis], dtype=np.float32)
        planes = along(cv2.resize(single, (len(single), to), interpolation=interpolation), planes, axis)
    return planes


def resampled(
    picture: Planes, pixel: Int[Array, "y x 2"], step: Integer[Array, "y x 2"], taps: Float[Array, "32 taps"]
) -> Float[Array, "y x 3"]:
    """Resample a picture as ``Rectification.apply`` does; its borders are mirrored.

    Args:
        picture: on the sensor. pixel: (x, y) of the first pixel that each place of the view reads.
        step: (x, y) beyond a whole pixel in 1/32 px. taps: weights of the pixels from the first one on, at each step.
    """
    flat, (rows, columns) = jnp.moveaxis(picture, 0, -1).reshape(-1, 3), picture.shape[1:]
    weights, count = taps[step], taps.shape[1]
    x = [_mirrored(pixel[..., 0] + tap, columns) for tap in range(count)]
    result = jnp.zeros(())
    for down in range(count):
        row = columns * _mirrored(pixel[..., 1] + down, rows)
        line = sum(weights[..., 0, right, None] * flat[row + column] for right, column in enumerate(x))
        result += weights[..., 1, down, None] * line
    return result


def _mirrored(index: Int[Array, "*n"], count: int) -> Int[Array, "*n"]:
    period = max(2 * (count - 1), 1)
    return jnp.minimum(index % period, period - index % period)
