"""The blur of a picture by the kernels of a layout of tiles."""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Float32, Float64
from scipy.signal import fftconvolve

from udccal.restoration.kernel_grid import KernelGrid, interpolated_kernels
from udccal.restoration.shrink import linear_weights
from udccal.restoration.tiles import TileLayout


def blurred(
    picture: Float32[np.ndarray, "rows columns 3"], grid: KernelGrid, layout: TileLayout
) -> Float32[np.ndarray, "rows columns 3"]:
    """Blur a sharp picture. A source's kernel is interpolated linearly between those of the layout.

    Args:
        picture: of the rows that the layout covers; beyond them it goes on mirrored.
        grid: kernels over the sensor.
        layout: the tiles.
    """
    kernels = interpolated_kernels(grid, layout.kernel_px)
    down, across = (size // 2 for size in kernels.shape[2:])
    wide = np.pad(picture, ((down, down), (across, across), (0, 0)), mode="symmetric")
    result = np.zeros((wide.shape[0] + 2 * down, wide.shape[1] + 2 * across, 3), dtype=np.float32)
    weights = [_weights(*each) for each in zip(layout.kernel_middles, layout.covered, (down, across), strict=True)]
    for own, ((rows, row_weights), (columns, column_weights)) in zip(kernels, product(*weights), strict=True):
        part = wide[rows, columns] * np.outer(row_weights, column_weights)[..., None]
        reached = result[rows.start : rows.stop + 2 * down, columns.start : columns.stop + 2 * across]
        for colour in range(3):
            reached[..., colour] += fftconvolve(part[..., colour], own[colour])
    return result[2 * down : -2 * down or None, 2 * across : -2 * across or None]


def _weights(
    middles: Float64[np.ndarray, " kernels"], count: int, reach: int
) -> list[tuple[slice, Float32[np.ndarray, " samples"]]]:
    """Return where each kernel takes part along one axis of a picture with ``reach`` px more on both sides."""
    hats = linear_weights(middles, np.arange(-reach, count + reach))
    found = []
    for hat in hats.T:
        some = np.flatnonzero(hat)
        at = slice(int(some[0]), int(some[-1]) + 1)
        found.append((at, hat[at]))
    return found
