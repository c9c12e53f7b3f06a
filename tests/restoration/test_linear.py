from __future__ import annotations

import inspect
from dataclasses import replace

import numpy as np

from udccal.models.noise import Noise, dark_DN
from udccal.restoration.linear import least_saturated_e, saturated, to_electrons, variance_e2


def test_black_level_gain_and_dark_current(toy_noise: Noise) -> None:
    mosaic = np.array([[64, 64 + 355]], np.uint16)
    np.testing.assert_allclose(to_electrons(mosaic, toy_noise, 0.5), [[-10.0, 990.0]], atol=1e-3)


def test_an_exposure_may_be_a_number_of_numpys(toy_noise: Noise) -> None:
    """OpenCV, which subtracts it, takes no others than Python's."""
    dark = inspect.unwrap(dark_DN)(toy_noise, np.float32(0.5))  # programs do not have the tests' own check of types
    assert type(dark) is float
    assert dark == dark_DN(toy_noise, 0.5)


def test_a_response_that_bends_is_straightened(toy_noise: Noise) -> None:
    full_DN = 3969 - 64
    linear_DN = np.array([[0.0, 100.0, 2000.0, 3800.0]])
    codes = np.rint(64 + linear_DN * (1 - 0.03 * linear_DN / full_DN)).astype(np.uint16)
    found = to_electrons(codes, replace(toy_noise, nonlinearity=0.03, dark_current_e_per_s=20.0), 0.5)
    np.testing.assert_allclose(found, linear_DN / 0.355 - 10.0, atol=0.6 / 0.355)
    assert abs(to_electrons(codes, toy_noise, 0.5)[0, 3] - 3800 / 0.355) > 100


def test_saturation_is_a_margin_below_the_full_well(toy_noise: Noise) -> None:
    assert saturated(np.array([[3800, 3960, 3969]], np.uint16), toy_noise).tolist() == [[False, True, True]]


def test_light_that_saturates_is_that_of_the_first_saturated_code(toy_noise: Noise) -> None:
    codes = np.arange(3800, 3970, dtype=np.uint16)[None]
    for nonlinearity in (0.0, 0.03):
        noise = replace(toy_noise, nonlinearity=nonlinearity, dark_current_e_per_s=20.0)
        first = to_electrons(codes, noise, 0.5)[saturated(codes, noise)].min()
        assert first - 1.1 / 0.355 < least_saturated_e(noise, 0.5) <= first + 1e-2


def test_variance_of_a_sample(toy_noise: Noise) -> None:
    signal = np.full((4, 4), 1000.0, np.float32)
    np.testing.assert_allclose(variance_e2(signal, toy_noise, 0.0), 1000 + 25 + (1 / 0.355) ** 2 / 12, rtol=1e-6)


def test_less_than_no_light_or_dark_current_makes_no_noise(toy_noise: Noise) -> None:
    dark, negative = np.full((4, 4), -50.0, np.float32), replace(toy_noise, dark_current_e_per_s=-1e4)
    np.testing.assert_array_equal(variance_e2(dark, negative, 1.0), variance_e2(dark * 0, toy_noise, 0.0))
