from __future__ import annotations

import itertools

import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.stats import norm

from tests.scenes.information import fisher_information
from udccal.fitting.engine.gaussian import cramer_rao


def _shot_noise(x: Float[Array, "2"], times: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """A rate in e-/s and a read variance in e-^2."""
    return x[0] * times, x[0] * times + x[1]


def _scatter_of_scores(clip: float, draws: int = 400_000) -> np.ndarray:
    """Covariance of the score, by simulation and numerical slopes of the log-likelihood written out on its own."""
    rng, times, x = np.random.default_rng(1), np.array([1.0, 4.0]), np.array([50.0, 16.0])
    y = x[0] * times + np.sqrt(x[0] * times + x[1]) * rng.standard_normal((draws, 2))
    seen = y < clip

    def log_likelihood(p: np.ndarray) -> np.ndarray:
        mean, sigma = p[0] * times, np.sqrt(p[0] * times + p[1])
        return np.where(seen, norm.logpdf(y, mean, sigma), norm.logsf(clip, mean, sigma)).sum(axis=1)

    steps = np.diag([1e-3, 1e-3])
    score = np.stack([(log_likelihood(x + s) - log_likelihood(x - s)) / 2e-3 for s in steps])
    return score @ score.T / draws


@pytest.mark.parametrize("clip", [np.inf, 230.0, 200.0, 190.0, 55.0])
def test_information_is_the_covariance_of_the_score(clip: float) -> None:
    found = fisher_information(_shot_noise, np.array([50.0, 16.0]), np.array([1.0, 4.0]), clip=clip)
    np.testing.assert_allclose(found, _scatter_of_scores(clip), rtol=0.02)


def test_clipped_samples_tell_less_and_never_something_negative() -> None:
    found = [
        fisher_information(_shot_noise, np.array([50.0, 16.0]), np.array([1.0, 4.0]), clip=c)
        for c in (np.inf, 300.0, 200.0, 100.0, 0.0, -1e4)
    ]
    for more, less in itertools.pairwise(found):
        assert np.linalg.eigvalsh(more - less).min() > -1e-9 * more.max()
    assert np.abs(found[-1]).max() < 1e-9


def test_bound_of_a_mean_falls_with_the_root_of_the_samples() -> None:
    information = fisher_information(_shot_noise, np.array([50.0, 16.0]), np.full(100, 2.0))
    known_variance = 1 / np.sqrt(information[0, 0])
    assert known_variance == pytest.approx(np.sqrt(116.0) / 2.0 / 10.0, rel=0.05)


def test_what_the_data_cannot_tell_is_infinite() -> None:
    # Only the sum of both is seen, with 4 times unit information.
    information = np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    assert np.isinf(cramer_rao(information)).all()
    quantities = np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    assert cramer_rao(information, quantities) == pytest.approx([0.5, np.inf, np.inf])


def test_scales_of_parameters_do_not_matter() -> None:
    scale = np.array([1e-9, 1.0, 1e8])
    information = np.diag([1.0, 4.0, 16.0]) * np.outer(scale, scale)
    assert cramer_rao(information) * scale == pytest.approx([1.0, 0.5, 0.25])
