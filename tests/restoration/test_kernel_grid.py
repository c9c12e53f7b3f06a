from __future__ import annotations

import numpy as np
import pytest

from tests.scenes.grid_blur import blurred
from udccal.restoration.kernel_grid import KernelGrid, interpolated_kernels


def test_kernels_at_the_nodes_are_those_of_the_grid(toy_grid: KernelGrid) -> None:
    places = np.stack(np.meshgrid(toy_grid.x_px, toy_grid.y_px), axis=-1).reshape(-1, 2)
    found = interpolated_kernels(toy_grid, places)
    np.testing.assert_allclose(found, toy_grid.kernels.reshape(found.shape), atol=1e-6)


def test_between_nodes_they_change_smoothly_and_beyond_them_they_stay(toy_grid: KernelGrid) -> None:
    bent = np.broadcast_to(toy_grid.x_px[None, :, None, None, None] ** 2, toy_grid.kernels.shape)
    grid = KernelGrid(toy_grid.x_px, toy_grid.y_px, bent)
    found = interpolated_kernels(grid, np.array([[-9.0, 3.0], [50.0, 3.0]]))
    np.testing.assert_allclose(found[:, 0, 0, 0], [0.0, 2500.0], atol=0.01)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_nodes_are_enough(toy_grid: KernelGrid, count: int) -> None:
    grid = KernelGrid(toy_grid.x_px[:count], toy_grid.y_px[:1], toy_grid.kernels[:1, :count])
    found = interpolated_kernels(grid, np.stack([grid.x_px, 0 * grid.x_px], axis=-1))
    np.testing.assert_allclose(found, grid.kernels[0], atol=1e-6)


def test_a_point_brings_the_kernel_of_its_own_place(toy_grid: KernelGrid) -> None:
    scene = np.zeros((96, 128), np.float32)
    scene[48, 64] = 1.0
    kernel = interpolated_kernels(toy_grid, np.array([[64.0, 48.0]]))[0, 1]
    np.testing.assert_allclose(blurred(toy_grid, 1, scene)[28:69, 60:69], kernel, atol=1e-5)
