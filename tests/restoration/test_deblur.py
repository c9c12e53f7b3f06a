from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from udccal.restoration.deblur import Deblurrer, expected_smoothness
from udccal.restoration.lowrank import KernelGrid, decompose
from udccal.restoration.operator import Blur, Canvas


@pytest.fixture(scope="module")
def deblurrer(toy_grid: KernelGrid) -> Deblurrer:
    canvas = Canvas.around(96, 128, 24, 8, workers=1)
    return Deblurrer.of(Blur.of(decompose(toy_grid, 0, 0.001, 20), canvas), iterations=60, tolerance=1e-3)


@pytest.fixture
def blurred(deblurrer: Deblurrer, toy_scene: np.ndarray) -> np.ndarray:
    canvas = deblurrer.blur.canvas
    return canvas.frame(deblurrer.blur.forward(canvas.extended(toy_scene[..., 0]))).copy()


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


def test_a_blurred_picture_becomes_sharp_again(
    deblurrer: Deblurrer, blurred: np.ndarray, toy_scene: np.ndarray
) -> None:
    solution = deblurrer.solve(blurred, np.ones(blurred.shape, bool), 1e-4)
    assert rms(solution.picture, toy_scene[..., 0]) < 0.5 * rms(blurred, toy_scene[..., 0])
    assert solution.residual <= 1e-3


def test_the_mean_kernel_alone_would_not_do(
    deblurrer: Deblurrer, blurred: np.ndarray, toy_scene: np.ndarray, toy_grid: KernelGrid
) -> None:
    """A deblurrer that is given one kernel for the whole field, the wrong input, does clearly worse."""
    flat = np.broadcast_to(toy_grid.kernels.mean(axis=(0, 1)), toy_grid.kernels.shape)
    grid = dataclasses.replace(toy_grid, kernels=np.ascontiguousarray(flat))
    canvas = deblurrer.blur.canvas
    uniform = Deblurrer.of(Blur.of(decompose(grid, 0, 0.001, 1), canvas), iterations=60, tolerance=1e-3)
    valid = np.ones(blurred.shape, bool)
    right, wrong = (d.solve(blurred, valid, 1e-3).picture for d in (deblurrer, uniform))
    assert rms(right, toy_scene[..., 0]) < 0.7 * rms(wrong, toy_scene[..., 0])


def test_the_streak_of_a_clipped_highlight_goes(deblurrer: Deblurrer, toy_scene: np.ndarray) -> None:
    scene = toy_scene[..., 0].copy()
    scene[40:44, 60:63] = 3.0e5
    canvas = deblurrer.blur.canvas
    seen = np.minimum(canvas.frame(deblurrer.blur.forward(canvas.extended(scene))), 11000.0)
    away = np.zeros(seen.shape, bool)
    away[22:34, 58:65] = away[50:62, 58:65] = True
    believed = deblurrer.solve(seen, np.ones(seen.shape, bool), 0.01).picture
    freed = deblurrer.solve(seen, seen < 10900.0, 0.01).picture
    assert rms(freed[away], scene[away]) < 0.5 * rms(believed[away], scene[away])


def test_a_dark_frame_stays_dark_and_finite(deblurrer: Deblurrer) -> None:
    solution = deblurrer.solve(np.zeros((96, 128), np.float32), np.ones((96, 128), bool), 0.1)
    assert not solution.picture.any()
    assert np.isfinite(expected_smoothness(np.zeros((4, 4), np.float32), 25.0, 0.03))


def test_a_frame_without_any_data_is_finite(deblurrer: Deblurrer) -> None:
    picture = deblurrer.solve(np.full((96, 128), 11000.0, np.float32), np.zeros((96, 128), bool), 0.1).picture
    assert np.isfinite(picture).all()
