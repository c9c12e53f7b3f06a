from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from udccal.cfa import cfa_named
from udccal.models.compose import bilinear_weights, expected_frame, mosaic_rate, space_varying_blur
from udccal.models.noise import Noise, electrons
from udccal.numerics import in_float64

NOISE = Noise(0.4, 64.0, 4000.0, 5.0, 0.1, 0.2, 1.0, 20.0, 2.0, 0.005)


@pytest.fixture
def kernels() -> np.ndarray:
    kernels = np.random.default_rng(0).random((2, 3, 5, 3))
    return kernels / kernels.sum((2, 3), keepdims=True)


@pytest.mark.medium
def test_a_point_brings_its_own_kernel(kernels: np.ndarray) -> None:
    weights = np.asarray(bilinear_weights(np.array([0.0, 20.0]), np.array([0.0]), 15, 21))
    scene = np.zeros((15, 21, 3))
    scene[7, 15] = 2.0
    blurred = np.asarray(in_float64(space_varying_blur)(scene, kernels, weights))
    expected = 2.0 * (0.25 * kernels[0] + 0.75 * kernels[1])
    np.testing.assert_allclose(blurred[5:10, 14:17], np.moveaxis(expected, 0, -1), atol=1e-6)
    # The other convention, sum_n w_n (k_n * x), weighs with the place where light arrives.
    at_arrival = 2.0 * np.einsum("nyx,ncyx->cyx", weights[:, 5:10, 14:17], kernels)
    assert np.abs(np.moveaxis(at_arrival, 0, -1) - blurred[5:10, 14:17]).max() > 1e-3


def test_light_is_kept_inside_and_lost_beyond_the_edge(kernels: np.ndarray) -> None:
    weights = np.asarray(bilinear_weights(np.array([0.0, 20.0]), np.array([0.0]), 15, 21))
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-6)
    blurred = np.asarray(space_varying_blur(np.ones((15, 21, 3)), kernels, weights))
    np.testing.assert_allclose(blurred[2:-2, 10], 1.0, atol=0.2)
    assert blurred[0, 0, 0] < 0.9


def test_samples_see_their_own_colour_and_the_wire_covers_the_backscatter() -> None:
    blurred = np.broadcast_to(np.array([1.0, 10.0, 100.0]), (4, 6, 3))
    rate = np.asarray(
        mosaic_rate(blurred, np.full((4, 6), 5.0), np.full((4, 6), 0.5), cfa_named("GBRG").channel_map(4, 6))
    )
    np.testing.assert_allclose(rate[:2, :2], [[7.5, 52.5], [3.0, 7.5]])


def test_mean_and_variance_follow_the_photon_transfer_curve() -> None:
    mean, variance = (np.asarray(v) for v in expected_frame(NOISE, np.full((2, 2), 1.0e5), 0.01))
    np.testing.assert_allclose(mean, 64.0 + 0.4 * 1000.2, rtol=1e-6)
    np.testing.assert_allclose(variance, 0.4**2 * (1000.0 + 0.2 + 25.0) + 1.0 / 12.0, rtol=1e-6)


def test_of_a_frame_whose_response_bends_electrons_are_found_again() -> None:
    bent = replace(NOISE, nonlinearity=0.02)
    mean, _ = expected_frame(bent, np.array([[0.0, 4e5, 9e5]]), 0.01)
    straight, _ = expected_frame(NOISE, np.array([[0.0, 4e5, 9e5]]), 0.01)
    assert float(mean[0, 2]) < float(straight[0, 2]) - 5
    found = np.asarray(electrons(bent, mean)) - float(NOISE.dark_current_e_per_s) * 0.01
    np.testing.assert_allclose(found, [[0.0, 4e3, 9e3]], rtol=1e-5, atol=1e-3)
