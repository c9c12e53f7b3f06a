"""The exact blur of a kernel grid: every pixel has the kernel of its own place."""

from __future__ import annotations

import numpy as np
from scipy.signal import fftconvolve

from udccal.restoration.kernel_grid import KernelGrid, interpolated_kernels


def blurred(grid: KernelGrid, channel: int, scene: np.ndarray) -> np.ndarray:
    """Blur one colour of a scene, which goes on beyond the frame as at its border."""
    ny, nx = grid.kernels.shape[:2]
    reach = [size // 2 for size in grid.kernels.shape[-2:]]
    wide = np.pad(scene, [(r, r) for r in reach], mode="edge")
    y, x = np.mgrid[: wide.shape[0], : wide.shape[1]]
    places = np.stack([x.ravel() - reach[1], y.ravel() - reach[0]], axis=-1).astype(np.float32)
    nodes = KernelGrid(grid.x_px, grid.y_px, np.eye(ny * nx, dtype=np.float32).reshape(ny, nx, 1, 1, -1))
    weights = interpolated_kernels(nodes, places).reshape(*wide.shape, -1)
    kernels = grid.kernels[:, :, channel].reshape(ny * nx, *grid.kernels.shape[-2:])
    parts = (fftconvolve(wide * weights[..., node], kernel, mode="same") for node, kernel in enumerate(kernels))
    return sum(parts)[reach[0] : -reach[0], reach[1] : -reach[1]].astype(np.float32)
