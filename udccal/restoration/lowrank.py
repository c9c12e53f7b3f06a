"""A space-varying psf in low rank: k(.; p) = sum_r c_r(p) h_r, by an SVD over field positions.

The kernel belongs to the source point (docs/conventions.md), so blurring is y = sum_r h_r * (c_r x).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline


@dataclass(frozen=True)
class KernelGrid:
    """Kernels on a regular grid of source positions; each channel of each kernel sums to 1."""

    x_px: Float[np.ndarray, " nx"]
    y_px: Float[np.ndarray, " ny"]
    kernels: Float[np.ndarray, "ny nx channels rows columns"]


@dataclass(frozen=True)
class LowRank:
    """Eigen-kernels of one channel and their coefficients at the grid's positions.

    ``residual`` is the RMS over the positions of the kernels' relative L2 error.
    """

    x_px: Float[np.ndarray, " nx"]
    y_px: Float[np.ndarray, " ny"]
    kernels: Float[np.ndarray, "rank rows columns"]
    coefficients: Float[np.ndarray, "rank ny nx"]
    residual: float


def decompose(grid: KernelGrid, channel: int, tolerance: float, max_rank: int) -> LowRank:
    """Decompose one channel at the smallest rank whose relative L2 error, RMS over positions, is at most ``tolerance``.

    The SVD includes the kernels' sums as one more, heavily weighted sample. sum_r c_r sum(h_r) then stays 1, and
    truncation adds no slow brightness pattern to the picture.
    """
    ny, nx, _, rows, columns = grid.kernels.shape
    samples = grid.kernels[:, :, channel].reshape(ny * nx, rows * columns).astype(np.float64)
    sums = samples.sum(axis=1, keepdims=True)
    augmented = np.concatenate([samples, sums * np.linalg.norm(samples, axis=1).max() * 10.0], axis=1)
    # The Gram matrix over positions is small; its eigenvectors are the left singular vectors.
    values, vectors = np.linalg.eigh(augmented @ augmented.T)
    order = np.argsort(values)[::-1]
    norms = np.linalg.norm(samples, axis=1)
    rank, left, right, residual = 0, vectors, samples, 1.0
    for rank in range(1, min(max_rank, len(order)) + 1):
        left = vectors[:, order[:rank]]
        right = left.T @ samples
        residual = float(np.sqrt(np.mean((np.linalg.norm(samples - left @ right, axis=1) / norms) ** 2)))
        if residual <= tolerance:
            break
    return LowRank(
        x_px=grid.x_px,
        y_px=grid.y_px,
        kernels=right.reshape(rank, rows, columns).astype(np.float32),
        coefficients=left.T.reshape(rank, ny, nx).astype(np.float32),
        residual=residual,
    )


def coefficient_map(
    low_rank: LowRank, index: int, x_px: Float[np.ndarray, " columns"], y_px: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, "rows columns"]:
    """Interpolate one coefficient to every pixel, bicubic inside the grid and constant outside it."""
    values = low_rank.coefficients[index].astype(np.float64)
    along_y = _interpolation(low_rank.y_px, y_px)
    along_x = _interpolation(low_rank.x_px, x_px)
    return (along_y @ values @ along_x.T).astype(np.float32)


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


def _interpolation(nodes: Float[np.ndarray, " n"], at: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m n"]:
    """Matrix from values at the nodes to the values of a spline at ``at``; cubic when there are four nodes or more."""
    if len(nodes) == 1:
        return np.ones((len(at), 1))
    spline = make_interp_spline(nodes, np.eye(len(nodes)), k=min(3, len(nodes) - 1))
    return spline(np.clip(at, nodes[0], nodes[-1]))
