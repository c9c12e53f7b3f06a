"""Patterns in errors whose noise and model error are known."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.validation.patterns import Samples, pattern_check, scatter_pattern

N, GROUPS, PIXELS = 3000, 20, 100


def drawn(seed: int, wrong: float = 0.0, model: float = 0.0) -> tuple[Samples, np.ndarray]:
    """Errors of unequal noise, of a model error that samples of one pixel share, and of one that groups share."""
    rng = np.random.default_rng(seed)
    pixel = rng.integers(0, PIXELS, N)
    group = pixel % GROUPS
    sigma = rng.uniform(1.0, 3.0, N)
    error = (
        sigma * (rng.normal(size=N) + wrong * rng.normal(size=GROUPS)[group]) + model * rng.normal(size=PIXELS)[pixel]
    )
    return Samples(error, sigma**2, np.full(N, model), pixel), group


def found(samples: Samples, group: np.ndarray) -> float:
    one = samples.pattern(group)
    return pattern_check("psf", "pattern", [one, one], 1.0, 1.0, "e-", "Samples").value or 0.0


@pytest.mark.parametrize("model", [0.0, 0.5])
def test_noise_and_the_stated_model_error_are_no_pattern(model: float) -> None:
    assert sum(found(*drawn(seed, model=model)) > 0 for seed in range(200)) <= 1


@pytest.mark.parametrize("model", [0.0, 0.3])
def test_a_pattern_has_its_size(model: float) -> None:
    """Half of sigma, which is from 1 to 3."""
    sizes = [found(*drawn(seed, 0.5, model)) for seed in range(20)]
    assert np.sqrt(np.mean(np.square(sizes))) == pytest.approx(0.5 * np.sqrt(13 / 3), rel=0.1)


def test_a_pattern_of_unknown_noise_is_found_and_chance_is_not() -> None:
    rng = np.random.default_rng(1)
    group = rng.integers(0, GROUPS, N)
    by_chance = [scatter_pattern(7 * rng.normal(size=N) + 5, group).test.p_value for _ in range(200)]
    assert min(by_chance) > 1e-5
    assert np.mean(by_chance) == pytest.approx(0.5, abs=0.08)
    one = scatter_pattern(7 * rng.normal(size=N) + 3 * rng.normal(size=GROUPS)[group], group)
    assert one.test.found
    assert np.sqrt(one.square) == pytest.approx(3.0, rel=0.4)


def test_one_group_alone_has_no_pattern() -> None:
    alone = scatter_pattern(np.arange(4.0), np.zeros(4, dtype=np.int64))
    assert not alone.test.found
    assert np.isfinite(alone.square)
