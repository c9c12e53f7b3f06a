from __future__ import annotations

import logging

import numpy as np
import pytest

from udccal.fitting.engine.iteration_log import LOG
from udccal.fitting.solvers import Solution, most_probable

_TIMES = np.linspace(0.0, 3.0, 50)
_FREE = np.ones(2, dtype=bool)
_ZERO, _WIDE = np.zeros(2), np.full(2, 1e6)


def _decay(y: np.ndarray):  # type: ignore[no-untyped-def]
    def errors_at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # A step too far overflows.
        with np.errstate(over="ignore", invalid="ignore"):
            shape = np.exp(-x[1] * _TIMES)
            return y - x[0] * shape, np.stack([-shape, x[0] * _TIMES * shape], axis=1)

    return errors_at


def _fitted(y: np.ndarray, free: np.ndarray = _FREE, mean: np.ndarray = _ZERO, sigma: np.ndarray = _WIDE) -> Solution:
    return most_probable(_decay(y), np.array([1.0, 0.2]), free, mean, sigma)


def test_finds_the_minimum_and_how_it_got_there(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, logger=LOG.name):
        found = _fitted(100 * np.exp(-1.3 * _TIMES))
    assert found.converged
    np.testing.assert_allclose(found.x, [100.0, 1.3], rtol=1e-4)
    assert len(found.history) == found.iterations + 1
    assert (np.diff(found.history) <= 0).all()
    assert sum("iteration" in line for line in caplog.messages) == len(found.history)


def test_the_covariance_is_that_of_many_fits() -> None:
    rng, clean = np.random.default_rng(0), 100 * np.exp(-1.3 * _TIMES)
    found = [_fitted(clean + rng.normal(size=50)) for _ in range(60)]
    spread = np.cov(np.array([one.x for one in found]).T)
    np.testing.assert_allclose(np.diag(found[0].cov), np.diag(spread), rtol=0.4)
    assert found[0].cov[0, 1] == pytest.approx(spread[0, 1], rel=0.4)


def test_a_narrow_prior_is_weighed() -> None:
    data = 100 * np.exp(-1.3 * _TIMES)
    found = _fitted(data, mean=np.array([0.0, 1.0]), sigma=np.array([1e6, 1e-5]))
    assert found.x[1] == pytest.approx(1.0, abs=1e-4)
    assert np.sqrt(found.cov[1, 1]) == pytest.approx(1e-5, rel=1e-2)


def test_what_is_held_stays_and_has_no_error_bar() -> None:
    found = _fitted(100 * np.exp(-1.3 * _TIMES), free=np.array([True, False]))
    assert found.x[1] == 0.2
    assert found.cov[1, 1] == found.cov[0, 1] == 0.0
    assert found.cov[0, 0] > 0.0


def test_without_finite_errors_it_stays_at_the_start_and_says_so() -> None:
    found = _fitted(np.full(50, np.nan))
    assert not found.converged
    np.testing.assert_array_equal(found.x, [1.0, 0.2])
    assert np.isfinite(found.cov).all()


def test_a_step_out_of_the_domain_is_taken_back() -> None:
    def errors_at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # The first Newton step from 1 lands at -8.
        with np.errstate(invalid="ignore", divide="ignore"):
            return 1e3 * np.log(x) + 9e3, 1e3 / x[:, None]

    found = most_probable(errors_at, np.array([1.0]), np.ones(1, dtype=bool), np.zeros(1), np.full(1, 1e6))
    assert found.converged
    assert found.x[0] == pytest.approx(np.exp(-9), rel=1e-3)


def test_it_has_not_converged_where_slopes_mislead() -> None:
    def errors_at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 1e3 * (x - 3.0), np.array([[-1e3]])

    found = most_probable(errors_at, np.zeros(1), np.ones(1, dtype=bool), np.zeros(1), np.full(1, 1e6))
    assert not found.converged
    assert found.x[0] == 0.0
