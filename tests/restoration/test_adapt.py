from __future__ import annotations

import numpy as np
import pytest

from udccal.restoration.adapt import adapted
from udccal.restoration.deblur import Deblurrer
from udccal.restoration.lowrank import KernelGrid, decompose
from udccal.restoration.operator import Blur, Canvas


@pytest.fixture(scope="module")
def deblurrer(toy_grid: KernelGrid) -> Deblurrer:
    canvas = Canvas.around(96, 128, 24, 8, workers=1)
    return Deblurrer.of(Blur.of(decompose(toy_grid, 0, 0.01, 20), canvas), iterations=10, tolerance=1e-3)


def test_dark_places_are_smoothed_and_bright_ones_left_alone(deblurrer: Deblurrer) -> None:
    rng = np.random.default_rng(0)
    picture = np.full((96, 128), 20.0, np.float32)
    picture[:, 64:] = 8000.0
    noisy = picture + rng.normal(0, 15, picture.shape).astype(np.float32)
    result = adapted(deblurrer, noisy, 0.02, 25.0, 0.17)
    dark, bright = (slice(8, -8), slice(8, 44)), (slice(8, -8), slice(84, -8))
    assert result[dark].std() < 0.3 * noisy[dark].std()
    np.testing.assert_allclose(result[bright], noisy[bright], atol=1e-2)
    assert abs(result[dark].mean() - noisy[dark].mean()) < 1.0


def test_a_picture_that_is_smooth_enough_comes_back(deblurrer: Deblurrer, toy_scene: np.ndarray) -> None:
    np.testing.assert_allclose(adapted(deblurrer, toy_scene[..., 0], 1e6, 25.0, 0.17), toy_scene[..., 0])
