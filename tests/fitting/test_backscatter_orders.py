"""Which order of the backscatter model is chosen on rigs whose order is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.efficiency.backscatter import (
    PICTURES,
    POSITIONS,
    World,
    panel_pictures,
    shots_of,
    small_rig,
    world,
)
from udccal.fitting.backscatter.data import PanelShots
from udccal.fitting.backscatter.fit import fit_shots, problem_of
from udccal.fitting.backscatter.light import Other, predict_light
from udccal.fitting.backscatter.report import known_from
from udccal.fitting.backscatter.select import choose
from udccal.fitting.backscatter.vector import KERNELS, TWO_PLANES, Order, without_crosstalk
from udccal.fitting.result import FitResult
from udccal.models.backscatter import Backscatter

RIG = small_rig()
ORDERS = (*KERNELS, without_crosstalk(TWO_PLANES))


def _made(seed: int, order: Order) -> tuple[World, PanelShots]:
    rng = np.random.default_rng([seed, 0x0DE])
    of = world(rng, RIG, order)
    return of, shots_of(of, rng, panel_pictures(RIG, 100 * seed, PICTURES))


def _chosen(result: FitResult[Backscatter]) -> str:
    return next(one.name for one in result.candidates if one.chosen)


@pytest.mark.slow
def test_the_right_order_is_chosen_in_95_of_100_runs() -> None:
    right = 0
    for seed in range(100):
        order = ORDERS[seed % len(ORDERS)]
        of, shots = _made(seed, order)
        right += _chosen(fit_shots(shots, of.term.geometry, RIG, POSITIONS)) == order.name
    assert right >= 95


@pytest.mark.parametrize("order", [KERNELS[0], TWO_PLANES], ids=lambda order: order.name)
def test_the_order_of_a_rig_is_found(order: Order) -> None:
    of, shots = _made(4, order)
    assert _chosen(fit_shots(shots, of.term.geometry, RIG, POSITIONS)) == order.name


def test_predicted_light_is_as_unsure_as_its_order() -> None:
    """With an order that predicts something else and may be right, error bars hold the difference."""
    of, shots = _made(0, TWO_PLANES)
    known = replace(known_from(choose(problem_of(shots, of.term.geometry, RIG, POSITIONS))), others=())
    place, new = np.arange(0, 190, 30), np.stack([shots.crop.of(one) for one in panel_pictures(RIG, 9000, 1)])
    alone = predict_light(known, shots, new, place)
    moved = known.x.copy()
    moved[6] += 0.5
    off = predict_light(replace(known, x=moved), shots, new, place)
    both = predict_light(replace(known, others=(Other(moved, known.cov, 0.4),)), shots, new, place)
    wanted = 0.6 * alone.sigma**2 + 0.4 * (off.sigma**2 + (off.rate - alone.rate) ** 2)
    np.testing.assert_allclose(both.rate, alone.rate)
    np.testing.assert_allclose(both.sigma, np.sqrt(wanted))
    assert (both.sigma > 1.5 * alone.sigma).any()
