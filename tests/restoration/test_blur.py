from __future__ import annotations

import numpy as np

from tests.scenes.grid_blur import blurred as exactly_blurred
from udccal.restoration.blur import blurred
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.tiles import layout_for

LAYOUT = layout_for(96, 128, (2, 2), (128, 128), (0, 96))


def test_one_kernel_blurs_as_a_convolution(toy_grid: KernelGrid, toy_scene: np.ndarray) -> None:
    middle = toy_grid.kernels[1:2, 2:3]
    grid = KernelGrid(toy_grid.x_px[2:3], toy_grid.y_px[1:2], middle)
    found = blurred(toy_scene, grid, LAYOUT)
    expected = np.stack([exactly_blurred(grid, c, toy_scene[..., c]) for c in range(3)], axis=-1)
    inner = np.s_[24:-24, 8:-8]
    np.testing.assert_allclose(found[inner], expected[inner], rtol=2e-4, atol=1.0)


def test_kernels_belong_to_their_source(toy_grid: KernelGrid) -> None:
    """A point has the kernel of its own place, also where its light falls into another tile's part."""
    scene = np.zeros((96, 128, 3), np.float32)
    row, column = 48, int(LAYOUT.strips[1][0].at.stop) - 24
    scene[row, column] = 1000.0
    found = blurred(scene, toy_grid, LAYOUT)
    exact = np.stack([exactly_blurred(toy_grid, c, scene[..., c]) for c in range(3)], axis=-1)
    assert np.linalg.norm(found - exact) < 0.1 * np.linalg.norm(exact)
    np.testing.assert_allclose(found.sum(axis=(0, 1)), 1000.0, rtol=1e-3)


def test_an_even_picture_stays_even(toy_grid: KernelGrid) -> None:
    found = blurred(np.full((96, 128, 3), 700.0, np.float32), toy_grid, LAYOUT)
    np.testing.assert_allclose(found, 700.0, rtol=0.01)
