from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from udccal.restoration.lowrank import KernelGrid, coefficient_map, decompose


def rebuilt(low_rank: object) -> np.ndarray:
    return np.einsum("ryx,rkl->yxkl", low_rank.coefficients, low_rank.kernels)


def test_full_rank_gives_the_kernels_back(toy_grid: KernelGrid) -> None:
    low_rank = decompose(toy_grid, 1, tolerance=0.0, max_rank=20)
    np.testing.assert_allclose(rebuilt(low_rank), toy_grid.kernels[:, :, 1], atol=1e-6)


def test_the_rank_follows_the_tolerance(toy_grid: KernelGrid) -> None:
    ranks = [len(decompose(toy_grid, 0, t, 20).kernels) for t in (0.3, 0.03, 0.003)]
    assert ranks[0] < ranks[1] < ranks[2] < 20
    assert decompose(toy_grid, 0, 0.03, 20).residual <= 0.03
    assert decompose(toy_grid, 0, 0.0, 2).residual > 0.01


def test_truncation_keeps_the_light(toy_grid: KernelGrid) -> None:
    sums = rebuilt(decompose(toy_grid, 2, 0.5, 2)).sum(axis=(2, 3))
    np.testing.assert_allclose(sums, 1.0, atol=2e-3)


def test_coefficients_are_interpolated_smoothly_and_held_outside(toy_grid: KernelGrid) -> None:
    low_rank = decompose(toy_grid, 0, 0.0, 1)
    bent = np.broadcast_to(low_rank.x_px**2, low_rank.coefficients.shape).astype(np.float32)
    values = coefficient_map(
        dataclasses.replace(low_rank, coefficients=bent), 0, np.array([-9.0, 50.0]), np.arange(3.0)
    )
    np.testing.assert_allclose(values, np.broadcast_to([0.0, 2500.0], (3, 2)), atol=0.01)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_positions_are_enough(toy_grid: KernelGrid, count: int) -> None:
    grid = KernelGrid(toy_grid.x_px[:count], toy_grid.y_px[:1], toy_grid.kernels[:1, :count])
    low_rank = decompose(grid, 0, 0.0, 5)
    values = coefficient_map(low_rank, 0, grid.x_px, grid.y_px)
    np.testing.assert_allclose(values, low_rank.coefficients[0], rtol=1e-4, atol=1e-7)
