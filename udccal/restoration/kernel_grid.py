"""Kernels on a grid over the sensor, and between its nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy.interpolate import make_interp_spline


@dataclass(frozen=True)
class KernelGrid:
    """Kernels on a regular grid of source positions; each channel of each kernel sums to 1."""

    x_px: Float[np.ndarray, " nx"]
    y_px: Float[np.ndarray, " ny"]
    kernels: Float[np.ndarray, "ny nx channels rows columns"]


def interpolated_kernels(
    grid: KernelGrid, positions_px: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n channels rows columns"]:
    """Interpolate the kernels of a grid to other source positions, bicubic inside the grid and constant outside it.

    Args:
        grid: kernels over the sensor.
        positions_px: (x, y) of the sources.
    """
    along_x = _interpolation(grid.x_px, positions_px[:, 0])
    along_y = _interpolation(grid.y_px, positions_px[:, 1])
    weights = (along_y[:, :, None] * along_x[:, None, :]).reshape(len(positions_px), -1)
    flat = grid.kernels.reshape(weights.shape[1], -1)
    return (weights.astype(np.float32) @ flat.astype(np.float32)).reshape(-1, *grid.kernels.shape[2:])


def centred(kernel: Float[np.ndarray, "ky kx"], rows: int, columns: int) -> Float64[np.ndarray, "rows columns"]:
    """Return a periodic picture of a kernel with its middle sample at (0, 0); a larger kernel wraps around."""
    placed = np.zeros((rows, columns))
    ky, kx = kernel.shape
    at_y, at_x = (np.arange(ky) - ky // 2) % rows, (np.arange(kx) - kx // 2) % columns
    np.add.at(placed, (at_y[:, None], at_x), kernel)
    return placed


def _interpolation(nodes: Float[np.ndarray, " n"], at: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m n"]:
    """Matrix from values at the nodes to the values of a spline at ``at``; cubic when there are four nodes or more."""
    if len(nodes) == 1:
        return np.ones((len(at), 1))
    spline = make_interp_spline(nodes, np.eye(len(nodes)), k=min(3, len(nodes) - 1))
    return spline(np.clip(at, nodes[0], nodes[-1]))
