"""The order of the photon transfer model on levels that are made, not measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from udccal.fitting.noise.data import NoiseRules
from udccal.fitting.noise.transfer import DarkVariance, Levels, Order, choose_transfer

DARK = DarkVariance(np.array([4.0]), np.array([0.01]), 1 / 12, 0.36, np.array([0.0]))


def made_levels(seed: int) -> Levels:
    """Ten levels of a linear sensor in bins of two brightnesses; in the last one only the dark half is usable."""
    rng = np.random.default_rng(seed)
    bins, samples = 32, 2e4
    pattern = np.where(np.arange(bins) % 2 == 0, 1.3, 0.7)
    light = np.append(np.linspace(0.05, 0.7, 9), 1.2)
    mean = 3000 * light[:, None] * pattern
    variance = 0.36 * mean + 4 + 1 / 12
    usable = np.ones(mean.shape, bool)
    usable[-1, ::2] = False
    return Levels(
        mean_DN=mean + np.sqrt(variance / samples) * rng.standard_normal(mean.shape),
        variance_DN2=variance * (1 + np.sqrt(4 / samples) * rng.standard_normal(mean.shape)),
        dof=np.full(mean.shape, samples / 2),
        samples=np.full(mean.shape, samples),
        usable=usable,
        uneven2=np.zeros(mean.shape),
        light=light,
        dark_DN=np.zeros(10),
        row_variance_DN2=np.zeros(10),
    )


def test_a_level_with_half_its_bins_does_not_make_the_light_unsteady() -> None:
    for seed in range(5):
        fit = choose_transfer(made_levels(seed), DARK, 4000.0, NoiseRules()).best.fit
        assert fit.order == Order()
        assert np.nanmax(np.abs(fit.level_z)) < 4.5


def test_a_level_that_is_brighter_than_its_exposure_makes_it_unsteady() -> None:
    levels = made_levels(0)
    factor = np.ones((10, 1))
    factor[[2, 5, 7]] = 1.004
    factor[[3, 6]] = 0.995
    choice = choose_transfer(replace(levels, mean_DN=levels.mean_DN * factor), DARK, 4000.0, NoiseRules())
    assert choice.best.fit.order.unsteady


def test_uneven_light_within_bins_does_not_look_like_more_curvature() -> None:
    """A panel's rows modulate a bin's light; its mean then lacks the mean of squares, not the square of the mean."""
    made, curvature, K, uneven2 = made_levels(3), 5e-6, 0.36, 0.04
    light = np.sqrt(uneven2) * np.array([[[-1.5]], [[-0.5]], [[0.5]], [[1.5]]]) / np.sqrt(1.25)
    z = made.mean_DN * (1 + light)
    bent = replace(
        made,
        mean_DN=np.mean(z - curvature * (z**2 + K * z), axis=0),
        variance_DN2=np.mean(K * z * (1 - 2 * curvature * z) ** 2, axis=0) + made.variance_DN2 - K * made.mean_DN,
        uneven2=np.full(made.mean_DN.shape, uneven2),
    )
    found = choose_transfer(bent, DARK, 4000.0, NoiseRules()).best.fit
    assert found.order.curved
    assert abs(found.values[2] - curvature) < 3 * found.cov[2, 2] ** 0.5
    # As if each bin's pixels had equal light.
    even = choose_transfer(replace(bent, uneven2=np.zeros(z.shape[1:])), DARK, 4000.0, NoiseRules()).best.fit
    assert even.values[2] - curvature > 3 * even.cov[2, 2] ** 0.5
