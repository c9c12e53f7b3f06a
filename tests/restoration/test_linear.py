from __future__ import annotations

from dataclasses import replace

import numpy as np

from udccal.models.noise import Noise
from udccal.restoration.linear import saturated, to_electrons, variance_e2


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
