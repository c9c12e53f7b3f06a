from __future__ import annotations

import math

import numpy as np
import pytest

from tests.benchmarks.pareto.edges import Edge, edge_rows
from tests.scenes.extremes import Extreme, Picture, extremes
from udccal.tiers import Tier


def test_the_worst_tier_has_the_row() -> None:
    steps = [Edge("dark", tier, overshoot) for tier, overshoot in zip(Tier, (0.01, 0.07, 0.02, 0.03), strict=True)]
    (row,) = edge_rows(steps)
    assert row.ok
    assert (row.name, row.value) == ("overshoot, dark (fast)", pytest.approx(7.0))


@pytest.mark.parametrize("broken", [0.09, math.nan, math.inf])
def test_an_overshoot_or_a_picture_that_is_not_finite_is_told(broken: float) -> None:
    edges = [
        *(Edge("dark", tier, 0.05) for tier in Tier),
        Edge("lamp", Tier.fast, broken),
        Edge("lamp", Tier.preview, 0),
    ]
    assert [row.ok for row in edge_rows(edges)] == [True, False]


@pytest.mark.medium
@pytest.mark.parametrize("name", ["90 % saturated", "odd size, 95 x 127", "three hot columns, beside them"])
def test_extremes_that_every_tier_keeps(name: str) -> None:
    extreme = next(each for each in extremes() if each.name == name)
    assert all(
        row.ok for row in edge_rows([Edge(name, tier, extreme.overshoot(extreme.restorer(tier))) for tier in Tier])
    )


def test_frames_that_do_not_show_the_step_are_told() -> None:
    def flipped(scene: Picture) -> None:
        scene[:] = np.flip(scene, axis=(0, 1)) * np.float32(1.2)

    extreme = Extreme("flipped", seen=flipped)
    assert not edge_rows([Edge("flipped", Tier.fast, extreme.overshoot(extreme.restorer(Tier.fast)))])[0].ok
