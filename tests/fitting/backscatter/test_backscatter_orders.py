"""Which order of the backscatter model is chosen on rigs whose order is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.backscatter import (
    PICTURES,
    RULES,
    Light,
    World,
    noise_free,
    panel_pictures,
    predicted_light,
    shots_of,
    small_rig,
    world,
    world_at,
)
from udccal.fitting.backscatter.data import BackscatterData
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.parameters import KERNELS, MIX, REFLECTION, TWO_PLANES, Order, prior_of, values_of
from udccal.fitting.backscatter.posterior import TermAt, linear_cov
from udccal.fitting.backscatter.search import search
from udccal.fitting.backscatter.solve import Fitted, Problem
from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.engine.orders import Attempt, Choice
from udccal.models.backscatter import Backscatter
from udccal.numerics import in_float64
from udccal.result import FitResult

RIG = small_rig()
ORDERS = (*KERNELS, TWO_PLANES.without_crosstalk())


# Rise of chi2, for pictures without noise, from which a part is there to be found: five sigma.
_SEEN = 25.0


def _made(seed: int, order: Order) -> tuple[World, BackscatterData]:
    """A rig drawn until each part of its order shows in its pictures: what does not show, nobody can find."""
    rng = np.random.default_rng([seed, 0x0DE])
    pictures = panel_pictures(RIG, 100 * seed, PICTURES)
    while True:
        of = world(rng, RIG, order)
        shots = shots_of(of, rng, pictures)
        if _shows(of, order, noise_free(shots, of, pictures)):
            return of, shots


@in_float64
def _shows(of: World, order: Order, expected: BackscatterData) -> bool:
    """Whether pictures without noise are described so much worse without any one part of the order."""
    problem = replace(Problem.of(expected, of.term.geometry, RIG, RULES), start=of.x)
    seen = problem.seen
    weight = seen.weights(seen.rate, seen.rate[0], 0.0, seen.usable)
    crosstalk = bool(order.free[MIX].any())
    kernels = KERNELS if crosstalk else tuple(kernel.without_crosstalk() for kernel in KERNELS)
    rises = [_rise(problem, one, weight) for one in kernels if _simpler(one, order)]
    if crosstalk:
        rises.append(_crosstalk_rise(problem.solved(order, of.x, weight).found.cov))
    return min(rises, default=np.inf) > _SEEN


def _simpler(one: Order, order: Order) -> bool:
    return bool((one.free <= order.free).all()) and one.parameters < order.parameters


def _rise(problem: Problem, order: Order, weight: np.ndarray) -> float:
    """Least chi2 of an order, from the truth and from one plane that sends its light from where two did."""
    merged = problem.start.copy()
    distance, reflection, depth = values_of(problem.start)[[1, REFLECTION, 5]]
    if order.free[REFLECTION] == 0:
        merged[1] = np.log(distance + depth * reflection / (1 + reflection))
    starts = (problem.start, merged) if reflection > 0 else (merged,)
    return min(problem.solved(order, x, weight).best.chi2 for x in starts)


def _crosstalk_rise(cov: np.ndarray) -> float:
    """Of chi2 without crosstalk, by its parabola at the truth: a fit would wander far.

    The covariance is of logarithms, that is of relative changes, and without crosstalk each changes by all of it.
    """
    return float(np.linalg.solve(cov[MIX, MIX], np.ones(6)) @ np.ones(6))


def _chosen(result: FitResult[Backscatter]) -> str:
    return next(one.name for one in result.candidates if one.chosen)


@pytest.mark.slow
def test_the_right_order_is_chosen_in_95_of_100_runs() -> None:
    right = 0
    for seed in range(100):
        order = ORDERS[seed % len(ORDERS)]
        of, shots = _made(seed, order)
        right += _chosen(fit_backscatter(shots, of.term.geometry, RIG, RULES)) == order.name
    assert right >= 95


@pytest.mark.parametrize(
    "order", [pytest.param(KERNELS[0], marks=pytest.mark.slow), TWO_PLANES], ids=lambda order: order.name
)
@pytest.mark.medium
def test_the_order_of_a_rig_is_found(order: Order) -> None:
    of, shots = _made(4, order)
    assert _chosen(fit_backscatter(shots, of.term.geometry, RIG, RULES)) == order.name


@pytest.mark.medium
def test_a_glass_that_reflects_next_to_nothing_does_not_show() -> None:
    faint, pictures = prior_of(RIG).mean, panel_pictures(RIG, 0, PICTURES)
    faint[REFLECTION] = np.log(1e-5)
    of = world_at(faint, RIG, np.full((3, 1, 1), 2e4))
    shots = shots_of(of, np.random.default_rng(0), pictures)
    assert not _shows(of, TWO_PLANES, noise_free(shots, of, pictures))


@pytest.mark.slow
def test_predicted_light_is_as_unsure_as_its_order() -> None:
    """With an order that predicts something else and may be right, error bars hold the difference."""
    of, shots = _made(0, TWO_PLANES)
    found = search(Problem.of(shots, of.term.geometry, RIG, RULES), (TWO_PLANES,))
    best, chosen = found.orders.best, found.fitted.found
    moved = chosen.x.copy()
    moved[6] += 0.1
    # As probable as e to minus half the criterion's rise: 0.4 of both together.
    fit = replace(best.fit, found=replace(chosen, x=moved))
    other = Attempt("other", 18, best.criterion - 2 * np.log(0.4 / 0.6), fit)

    def predicted(*tried: Attempt[Fitted]) -> tuple[Posterior[Backscatter], Light]:
        known = replace(found, orders=Choice(tried[0], tried))
        posterior = TermAt.of(shots, known).posterior(linear_cov(known, np.ones(18)))
        term = posterior.term_at(posterior.mean)
        return posterior, predicted_light(term, posterior, 0.0, RIG, new, place)

    new, place = panel_pictures(RIG, 9000, 1), np.arange(0, 190, 30)
    posterior, alone = predicted(best)
    shift = np.zeros_like(posterior.mean)
    shift[6] = 0.1
    off = predicted_light(posterior.term_at(posterior.mean + shift), posterior, 0.0, RIG, new, place)
    both = predicted(best, other)[1]
    wanted = np.sqrt(alone.sigma**2 + 0.4 * (off.rate - alone.rate) ** 2)
    np.testing.assert_allclose(both.rate, alone.rate)
    np.testing.assert_allclose(both.sigma, wanted, rtol=0.1)
    assert (both.sigma > 1.5 * alone.sigma).any()
