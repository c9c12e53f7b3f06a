from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from jaxtyping import Float

from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Posterior, Prior, scaled_inverse, square_root
from udccal.result import FitResult, FitStatus

COV = np.array([[4.0, 1e-3, 0.0], [1e-3, 1e-6, 0.0], [0.0, 0.0, 0.0]])


def _posterior() -> Posterior[Float[np.ndarray, "3"]]:
    return Posterior.from_cov(np.array([10.0, 0.02, 5.0]), COV, lambda x: x)


def test_a_prior_adds_cost_and_the_slope_of_it() -> None:
    prior, x, step = Prior.independent(np.array([1.0, 2.0]), np.array([0.5, np.inf])), np.array([2.0, 9.0]), 1e-6
    assert prior.cost(x) == pytest.approx(4.0)
    assert prior.sigma == pytest.approx([0.5, np.inf])
    along = np.array([step, 0.0])
    slope = (prior.cost(x + along) - prior.cost(x - along)) / (2 * step)
    assert prior.right(x) == pytest.approx([-slope / 2, 0.0], rel=1e-6)


def test_sigma_of_a_linear_function_is_exact() -> None:
    slopes = np.array([[1.0, 0.0, 0.0], [1.0, 100.0, 3.0]])
    expected = np.sqrt(np.diag(slopes @ COV @ slopes.T))
    assert _posterior().sigma_of(lambda x: slopes @ x) == pytest.approx(expected, rel=1e-9)


def test_sigma_of_a_curved_function_is_that_of_its_draws() -> None:
    posterior = _posterior()

    def f(x: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2"]:
        return np.array([np.exp(x[1]), x[0] * x[1]])

    drawn = np.std([f(x) for x in posterior.draws(np.random.default_rng(3), 20_000)], axis=0)
    assert posterior.sigma_of(f) == pytest.approx(drawn, rel=0.03)
    # A posterior without covariance between the two would be off by more.
    alone = Posterior.from_cov(posterior.mean, np.diag(np.diag(COV)), lambda x: x)
    assert abs(alone.sigma_of(f)[1] / drawn[1] - 1) > 0.03


def test_a_propagated_function_has_value_sigma_and_covariance() -> None:
    slopes = np.array([[1.0, 0.0, 0.0], [1.0, 100.0, 3.0]])
    found = _posterior().propagate(lambda x: slopes @ x)
    assert found.value == pytest.approx(slopes @ [10.0, 0.02, 5.0])
    assert found.cov == pytest.approx(slopes @ COV @ slopes.T, rel=1e-9)
    assert found.sigma == pytest.approx(_posterior().sigma_of(lambda x: slopes @ x), rel=1e-12)
    number = _posterior().propagate(lambda x: x[0] * x[1])
    assert (number.value.shape, number.sigma.shape, number.cov.shape) == ((), (), (1, 1))
    assert number.sigma == pytest.approx(np.sqrt([0.02, 10.0] @ COV[:2, :2] @ [0.02, 10.0]), rel=1e-6)
    # Of a function that two correlated parameters enter, the sigma is not that of independent ones.
    assert abs(number.sigma / np.hypot(0.02 * 2.0, 10.0 * 1e-3) - 1) > 0.1


@pytest.mark.parametrize("asked", ["sigma_of", "propagate"])
@pytest.mark.parametrize(
    ("f", "words"),
    [
        (lambda x: np.where(x > 9, x, np.nan), "finite numbers of the function, found 2 of 3 that are not"),
        (lambda x: np.log(10.0 - x[0]), "finite numbers of the function, found 1 of 1"),
        (lambda x: None, "real numbers of the function, found NoneType"),
        (lambda x: "x", "real numbers of the function, found str"),
        (lambda x: x + 1j, r"real numbers of the function, found complex128 of shape \(3,\)"),
        (lambda x: [[1.0], [1.0, 2.0]], "real numbers of the function, found list"),
        (7, "a function of the term, found int"),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.usefixtures("as_other_programs_call")
def test_what_gives_no_finite_numbers_is_refused(f: Any, words: str, asked: str) -> None:
    """NaN came out as a sigma of NaN, and the others as tracebacks of numpy."""
    with pytest.raises(FitError, match=words):
        getattr(_posterior(), asked)(f)


def test_the_functions_own_error_passes() -> None:
    with pytest.raises(ZeroDivisionError):
        _posterior().sigma_of(lambda x: np.asarray(1 / int(0 * x[0])))


def test_a_propagated_map_keeps_its_shape() -> None:
    found = _posterior().propagate(lambda x: np.outer(x, x))
    assert found.value.shape == found.sigma.shape == (3, 3)
    assert found.cov.shape == (9, 9)
    certain = Posterior(np.zeros(2), np.zeros((2, 2)), lambda x: x).propagate(lambda x: x)
    assert certain.cov == pytest.approx(np.zeros((2, 2)))


def test_parameters_of_unlike_size_keep_their_digits() -> None:
    cov = np.array([[1e18, 3e5], [3e5, 1e-6]])
    root = square_root(cov)
    assert root @ root.T == pytest.approx(cov, rel=1e-9)
    inverse = np.array([[1e-6, -3e5], [-3e5, 1e18]]) / (1e12 - 9e10)
    assert scaled_inverse(cov) == pytest.approx(inverse, rel=1e-9)


def test_directions_without_information_have_no_inverse() -> None:
    assert scaled_inverse(np.diag([4.0, 0.0])) == pytest.approx(np.diag([0.25, 0.0]))


def test_results_answer_for_functions_of_their_term_or_say_why_not() -> None:
    fitted = FitResult("wire", np.zeros(3), FitStatus.CONVERGED, (), COV, 1.0, 9, posterior=_posterior())
    assert fitted.sigma_of(lambda x: x[:1]) == pytest.approx([2.0])
    assert fitted.propagate(lambda x: x[:1]).sigma == pytest.approx([2.0])
    with pytest.raises(FitError, match="wire fit with a posterior, found none"):
        FitResult.failed("wire", np.zeros(3), FitStatus.TOO_DARK, "No light.").sigma_of(lambda x: x)
