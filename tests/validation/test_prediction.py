"""Chi-squared and patterns of predicted data whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.validation.prediction import Prediction

N, GROUPS = 400, 20


def drawn(seed: int, wrong: float = 0.0, stated: bool = True) -> tuple[Prediction, np.ndarray]:
    """Noise, an error of the profile along two directions, and a parameter of the capture that was solved for."""
    rng = np.random.default_rng(seed)
    own = np.linalg.qr(rng.normal(size=(N, 3)))[0]
    slopes = rng.normal(size=(N, 2))
    group = np.arange(N) % GROUPS
    z = rng.normal(size=N) + slopes @ rng.normal(size=2) + wrong * np.where(group < GROUPS / 2, 1.0, -1.0)
    return Prediction(z - own @ (own.T @ z), own, slopes if stated else np.zeros((N, 0))), group


def test_chi_squared_is_that_of_noise_and_of_the_profiles_error() -> None:
    ratios = [one.chi2 / one.dof for one, _ in (drawn(seed) for seed in range(40))]
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.03)


def test_an_error_that_the_profile_does_not_state_shows() -> None:
    found = [one.chi2 / one.dof for one, _ in (drawn(seed, stated=False) for seed in range(10))]
    assert np.mean(found) > 1.5


def test_a_pattern_is_found_and_chance_is_not() -> None:
    by_chance = [one.pattern(group)[0].found for one, group in (drawn(seed) for seed in range(100))]
    assert sum(by_chance) <= 2
    one, group = drawn(0, wrong=0.5)
    test, size = one.pattern(group)
    assert test.found
    assert size == pytest.approx(0.5, abs=0.2)


def test_a_group_that_was_solved_for_tells_nothing() -> None:
    """Of three groups, the parameters of the capture have removed one, or all."""
    group, z = np.arange(3), np.array([0.0, 9.0, -9.0])
    test, size = Prediction(z, np.eye(3)[:, :1], np.zeros((3, 0))).pattern(group)
    assert test.found
    assert size == pytest.approx(np.sqrt(160 / 3))
    assert Prediction(0 * z, np.eye(3), np.zeros((3, 0))).pattern(group)[1] == 0.0
