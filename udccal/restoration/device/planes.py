"""What OpenCV does to planes on a CPU, for arrays on a device: filters, other sizes, sites taken apart.

Planes are the last two axes of an array. Borders are mirrored at the last sample, as BORDER_REFLECT_101 does.
"""

from __future__ import annotations

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Shaped


def apart(
    mosaic: Shaped[Array, "*n rows columns"], cell: tuple[int, int]
) -> Shaped[Array, "*n places place_rows place_columns"]:
    """Return the samples of each place of a ``cell`` (rows, columns) as a plane of its own, row by row."""
    *n, rows, columns = mosaic.shape
    split = mosaic.reshape(*n, rows // cell[0], cell[0], columns // cell[1], cell[1])
    return jnp.moveaxis(split, (-3, -1), (-4, -3)).reshape(*n, -1, rows // cell[0], columns // cell[1])


def together(
    planes: Shaped[Array, "*n places place_rows place_columns"], cell: tuple[int, int]
) -> Shaped[Array, "*n rows columns"]:
    """Return the mosaic whose places ``apart`` finds."""
    *n, _, rows, columns = planes.shape
    split = jnp.moveaxis(planes.reshape(*n, *cell, rows, columns), (-4, -3), (-3, -1))
    return split.reshape(*n, rows * cell[0], columns * cell[1])


def convolved(
    planes: Float[Array, "*n rows columns"], taps: Float32[np.ndarray, " taps"], axis: int
) -> Float[Array, "*n rows columns"]:
    """Filter planes along one axis, -2 or -1; of an even number of taps, one more lies before the sample."""
    size, count = len(taps), planes.shape[axis]
    pads = [(0, 0)] * planes.ndim
    pads[axis] = (size // 2, size - 1 - size // 2)
    wide = jnp.pad(planes, pads, mode="reflect")
    taken = (jax.lax.slice_in_dim(wide, k, k + count, axis=axis % planes.ndim) for k in range(size))
    return sum(tap * part for tap, part in zip(taps, taken, strict=True))


def box_mean(planes: Float[Array, "*n rows columns"], size: int) -> Float[Array, "*n rows columns"]:
    """Return the mean of ``size`` x ``size`` samples around each."""
    taps = np.full(size, 1 / size, np.float32)
    return convolved(convolved(planes, taps, -2), taps, -1)


def along(
    matrix: Float32[np.ndarray, "to of"], values: Float[Array, "*shape"], axis: int
) -> Float[Array, "*other_shape"]:
    """Multiply along one axis by a matrix that has few numbers beside 0 in a row, by gathers."""
    most = int(np.count_nonzero(matrix, axis=1).max())
    index = np.argsort(matrix == 0, axis=1, kind="stable")[:, :most]
    weights = np.take_along_axis(matrix, index, axis=1)
    shape = [1] * values.ndim
    shape[axis] = len(matrix)
    taken = (jnp.take(values, at, axis=axis) for at in index.T)
    return sum(part * weight.reshape(shape) for part, weight in zip(taken, weights.T, strict=True))


def resized(
    planes: Float[Array, "*n rows columns"], size: tuple[int, int], interpolation: int
) -> Float[Array, "*n new_rows new_columns"]:
    """Return planes of another ``size`` (rows, columns), by one of OpenCV's interpolations."""
    for axis, count in zip((-2, -1), size, strict=True):
        planes = along(resizing(planes.shape[axis], count, interpolation), planes, axis)
    return planes


def resizing(of: int, to: int, interpolation: int) -> Float32[np.ndarray, "to of"]:
    """Return the matrix by which OpenCV resizes along one axis."""
    return cv2.resize(np.eye(of, dtype=np.float32), (of, to), interpolation=interpolation)
