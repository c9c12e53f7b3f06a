from __future__ import annotations

import logging

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from udccal.fitting.iteration_log import LOG
from udccal.fitting.solvers import least_squares

_TIMES = np.linspace(0.0, 3.0, 50)


def _decay(x: Float[Array, "2"], t: Float[Array, " n"], y: Float[Array, " n"]) -> Float[Array, " n"]:
    return y - x[0] * jnp.exp(-x[1] * t)


def _logarithm(x: Float[Array, "2"], t: Float[Array, " n"], y: Float[Array, " n"]) -> Float[Array, " n"]:
    return y - x[0] * jnp.log(x[1] * t)


def test_finds_the_minimum_and_how_it_got_there(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, logger=LOG.name):
        found = least_squares(_decay, np.array([1.0, 0.2]), np.ones(2), _TIMES, 2 * np.exp(-1.3 * _TIMES))
    assert found.converged
    np.testing.assert_allclose(found.x, [2.0, 1.3], rtol=1e-9)
    assert len(found.history) == found.iterations + 1
    assert (np.diff(found.history) <= 0).all()
    assert found.history[-1] == pytest.approx(found.chi2, abs=1e-20)
    assert sum("_decay: iteration" in line for line in caplog.messages) == len(found.history)


def test_without_finite_residuals_it_stays_at_the_start_and_says_so() -> None:
    found = least_squares(_logarithm, np.array([1.0, -0.2]), np.ones(2), _TIMES + 1, np.exp(-_TIMES))
    assert not found.converged
    np.testing.assert_array_equal(found.x, [1.0, -0.2])
    assert np.isfinite(found.chi2)
    assert np.isfinite(found.cov).all()


def test_too_few_iterations_have_not_converged() -> None:
    data = 2 * np.exp(-1.3 * _TIMES) + 0.1 * np.random.default_rng(1).standard_normal(len(_TIMES))
    assert not least_squares(_decay, np.array([1.0, 0.2]), np.ones(2), _TIMES, data, max_iterations=1).converged
