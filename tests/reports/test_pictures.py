"""Scores of pictures."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.reports.pictures import compare_pictures, mosaic_preview


@pytest.fixture
def truth() -> np.ndarray:
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0:48, 0:64] / 64.0
    return 1000.0 * (0.4 + 0.3 * np.sin(9 * x)[..., None] * np.cos(7 * y)[..., None] + 0.05 * rng.random((48, 64, 3)))


def test_before_is_forgiven_its_gain_and_after_is_not(truth: np.ndarray) -> None:
    gains = np.array([0.5, 0.6, 0.7])
    same = compare_pictures("scene", truth * gains, truth, truth)
    assert same.score_before.psnr_dB == pytest.approx(120.0)
    assert same.score_after.ssim == pytest.approx(1.0)
    wrong_level = compare_pictures("scene", truth, truth * 0.5, truth)
    assert wrong_level.score_after.psnr_dB < 20.0
    assert wrong_level.gain_dB < -90.0


def test_more_noise_scores_lower(truth: np.ndarray) -> None:
    rng = np.random.default_rng(6)
    noise = rng.normal(size=truth.shape)
    scene = compare_pictures("scene", truth + 100 * noise, truth + 10 * noise, truth)
    assert scene.gain_dB == pytest.approx(20.0, abs=1.5)
    assert scene.score_after.ssim > scene.score_before.ssim


def test_preview_puts_each_colour_where_it_belongs() -> None:
    mosaic = np.tile(np.array([[10, 20], [30, 40]], np.uint16), (3, 4))
    assert np.array_equal(mosaic_preview(mosaic, "RGGB", 5.0)[0, 0], [5.0, 20.0, 35.0])
    assert np.array_equal(mosaic_preview(mosaic, "GBRG", 5.0)[0, 0], [25.0, 20.0, 15.0])
    assert mosaic_preview(mosaic, "RGGB", 100.0).max() == 0.0
