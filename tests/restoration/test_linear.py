from __future__ import annotations

from dataclasses import replace

import numpy as np

from udccal.models.noise import Noise
from udccal.restoration.linear import saturated, to_electrons, variance_e2, without_defects


def test_black_level_gain_and_dark_current(toy_noise: Noise) -> None:
    mosaic = np.array([[64, 64 + 355]], np.uint16)
    np.testing.assert_allclose(to_electrons(mosaic, toy_noise, 0.5), [[-10.0, 990.0]], atol=1e-3)


def test_saturation_is_a_margin_below_the_full_well(toy_noise: Noise) -> None:
    assert saturated(np.array([[3800, 3960, 3969]], np.uint16), toy_noise).tolist() == [[False, True, True]]


def test_variance_of_a_sample(toy_noise: Noise) -> None:
    signal = np.full((4, 4), 1000.0, np.float32)
    np.testing.assert_allclose(variance_e2(signal, toy_noise, 0.0), 1000 + 25 + (1 / 0.355) ** 2 / 12, rtol=1e-6)


def test_less_than_no_light_or_dark_current_makes_no_noise(toy_noise: Noise) -> None:
    dark, negative = np.full((4, 4), -50.0, np.float32), replace(toy_noise, dark_current_e_per_s=-1e4)
    np.testing.assert_array_equal(variance_e2(dark, negative, 1.0), variance_e2(dark * 0, toy_noise, 0.0))


def test_hot_and_dead_samples_are_replaced(toy_noise: Noise) -> None:
    rng = np.random.default_rng(0)
    frame = rng.normal(500.0, 22.0, (64, 64)).astype(np.float32)
    broken = frame.copy()
    broken[20, 21], broken[41, 40] = 5000.0, -800.0
    mended = without_defects(broken, toy_noise, "RGGB")
    assert abs(mended[20, 21] - 500) < 60
    assert abs(mended[41, 40] - 500) < 60
    untouched = mended == broken
    assert untouched.mean() > 0.999


def test_a_star_behind_the_panel_is_no_defect(toy_noise: Noise) -> None:
    """Every second sample down the middle of a panel's psf: a star one pixel wide, seen by one colour of the CFA."""
    frame = np.full((64, 64), 10.0, np.float32)
    frame[28:37, 30] += 10000 * np.array([0.02, 0.02, 0.1, 0.1, 0.38, 0.1, 0.1, 0.02, 0.02], np.float32)
    np.testing.assert_array_equal(without_defects(frame, toy_noise, "RGGB"), frame)
