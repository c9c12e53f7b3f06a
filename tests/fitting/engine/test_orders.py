from __future__ import annotations

import numpy as np
import pytest

from udccal.fitting.engine.orders import Attempt, Quantity, bic, choose, evidence, held_out_beats, rising


def _attempt(name: str, criterion: float) -> Attempt[str]:
    return Attempt(name, len(name), criterion, name)


def test_the_lowest_criterion_wins_and_all_are_listed() -> None:
    choice = choose([_attempt("flat", 9.0), _attempt("straight", 3.0), _attempt("bent", 4.0)])
    assert choice.best.fit == "straight"
    assert [c.chosen for c in choice.candidates] == [False, True, False]
    assert choice.probabilities[1] / choice.probabilities[2] == pytest.approx(np.exp(0.5))


def test_failed_orders_are_never_chosen() -> None:
    assert choose([_attempt("failed", np.inf), _attempt("poor", 1e9)]).best.name == "poor"


def test_rising_orders_end_after_two_in_vain() -> None:
    criteria = [9.0, 9.5, 5.0, 6.0, 7.0, 0.0]
    tried = rising(
        (lambda k=k, c=c: _attempt("x" * k, c) for k, c in enumerate(criteria)), lambda a, b: a.criterion < b.criterion
    )
    assert [t.criterion for t in tried] == criteria[:5]


def test_evidence_is_the_exact_integral_of_a_linear_model() -> None:
    """Of y ~ N(slopes x, 1), x ~ N(0, prior): -2 ln p(y) by the covariance of y itself."""
    rng = np.random.default_rng(4)
    slopes, prior, y = rng.standard_normal((30, 2)), np.array([0.5, 3.0]), rng.standard_normal(30)
    whole = np.eye(30) + (slopes * prior**2) @ slopes.T
    exact = y @ np.linalg.solve(whole, y) + np.linalg.slogdet(whole)[1]
    cov = np.linalg.inv(slopes.T @ slopes + np.diag(prior**-2.0))
    x = cov @ slopes.T @ y
    cost = float(((y - slopes @ x) ** 2).sum() + ((x / prior) ** 2).sum())
    assert evidence(cost, cov, prior) == pytest.approx(exact, rel=1e-9)
    assert evidence(cost, cov, prior, against=2.0) == pytest.approx(exact + 2.0, rel=1e-9)


def test_bic_prices_a_parameter_at_the_logarithm_of_the_samples() -> None:
    assert bic(10.0, 3.0, 100) - bic(10.0, 2.0, 100) == pytest.approx(np.log(100))


def test_one_lucky_group_is_no_gain() -> None:
    before = np.full(8, 2.0)
    assert held_out_beats(before - 0.1, before)
    assert not held_out_beats(before - np.array([0.8, *[0.0] * 7]), before)
    assert not held_out_beats(before - 0.1, before, worth=0.2)
    assert not held_out_beats(np.array([1.0]), np.array([2.0]))


def test_a_quantity_stays_where_the_data_ask_for_it() -> None:
    found = Quantity.asked("spread", 5.0, 1.0, 1000)
    assert (found.value, found.there, found.candidates[1].name) == (5.0, True, "with spread")
    for value, gain in ((2.0, None), (-9.0, None), (9.0, 0.0)):
        lost = Quantity.asked("spread", value, 1.0, 1000, gain)
        assert (lost.value, lost.there) == (0.0, False)
        assert lost.variance >= 1.0
        assert [candidate.chosen for candidate in lost.candidates] == [True, False]


@pytest.mark.parametrize("true", [0.0, 1.0, 2.0, 3.0, 4.0, 6.0])
def test_the_sigma_of_a_quantity_holds_that_the_choice_may_be_wrong(true: float) -> None:
    errors = np.random.default_rng(2).normal(size=2000)
    found = [Quantity.asked("spread", true + error, 1.0, 50_000) for error in errors]
    z = np.array([(one.value - true) / one.variance**0.5 for one in found])
    assert np.sqrt(np.mean(z**2)) < 1.4
    # Its own sigma alone does not hold.
    assert true != 3.0 or np.sqrt(np.mean([(one.value - true) ** 2 for one in found])) > 2.0


def test_the_root_of_a_variance_that_is_lost_in_its_error_is_as_uncertain_as_that() -> None:
    assert Quantity(400.0, 0.01).root() == (20.0, pytest.approx(0.025, rel=1e-3))
    # Three sigma lower, the variance is 1, and the root 1 lower.
    assert Quantity(4.0, 1.0).root() == (2.0, pytest.approx(1 / 3))
    value, slope = Quantity(0.0, 1e-4).root()
    assert (value, slope * 1e-2) == (0.0, pytest.approx(0.1))


def test_what_the_data_hardly_determine_keeps_the_doubt_of_the_orders_above() -> None:
    """The order above finds its parameter at 0 by chance, to 3.0; the chosen one holds it at 0 exactly."""
    choice = choose([Attempt("without", 0, 0.0, 0.0), Attempt("with", 1, bic(0.0, 1.0, 1000), 9.0)])
    weight = np.exp(-1.0) / (1 + np.exp(-1.0))
    assert choice.spread(1000, lambda own: np.zeros(1))[0, 0] == 0.0
    assert choice.spread(1000, lambda own: np.zeros(1), cov=lambda own: np.full((1, 1), own))[0, 0] == pytest.approx(
        9.0 * weight
    )


def test_a_part_of_the_variance_of_the_order_with_every_parameter_is_kept() -> None:
    """The order with both parameters is so unlikely by its criterion that its weight is 0."""
    tried = [Attempt("none", 0, 0.0, np.zeros(2)), Attempt("both", 2, 1e3, np.array([4.0, 9.0]))]
    found = choose(tried).spread(1000, lambda own: np.zeros(2), cov=np.diag, least=0.25)
    np.testing.assert_allclose(found, np.diag([1.0, 2.25]))
    failed = choose([*tried, Attempt("all", 3, np.inf, np.full(2, 99.0))])
    np.testing.assert_allclose(failed.spread(1000, lambda own: np.zeros(2), cov=np.diag, least=0.25), found)


def test_an_order_above_that_seems_to_know_more_takes_no_variance_off() -> None:
    choice = choose([Attempt("without", 0, 0.0, 9.0), Attempt("with", 1, bic(0.0, 1.0, 1000), 1.0)])
    found = choice.spread(1000, lambda own: np.zeros(2), cov=lambda own: np.diag([own, 2.0]))
    np.testing.assert_allclose(found, 0.0, atol=1e-12)
