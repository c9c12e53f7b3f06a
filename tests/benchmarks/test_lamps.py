"""A frame in which lamps are not taken off, or are found where there are none, misses a limit."""

from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks.lamps import COLUMNS, ROWS, Drawn, Gained, gained, rows_of
from udccal.cfa import PATTERNS
from udccal.rig import load_rig


def missed(results: list[Gained]) -> list[str]:
    return [row.name for row in rows_of(results) if not row.ok]


def test_each_limit_can_be_missed() -> None:
    good = [Gained(25.0, 26.0, True)] * 19
    assert missed([*good, Gained(30.0, 30.0, False)]) == []
    assert missed([*good, Gained(25.0, 24.0, True)]) == ["worst gain of these (at least)"]
    assert missed([Gained(25.0, 25.1, True)] * 20) == ["median gain of these (at least)"]
    assert missed([*good, *[Gained(25.0, 24.9, True)] * 3]) == ["part of these that gain (at least)"]
    assert len(missed([Gained(30.0, 30.0, False)])) == 4


@pytest.mark.medium
def test_a_drawn_lamp_gains_and_an_even_wall_does_not() -> None:
    y, x = np.mgrid[-40:41, -8:9]
    tail = np.exp(-(x**2) / 1.5 - np.abs(y) / 12.0)
    kernels = np.stack([tail / tail.sum()] * 3)
    wall = np.full((ROWS, COLUMNS, 3), 3e3)
    lit = wall.copy()
    lit[140:148, 200:208] = 4e5
    dark, bright = (
        gained(Drawn(scene, PATTERNS["RGGB"], 1e4, kernels, kernels, 3), load_rig("lg55-reduced"))
        for scene in (wall, lit)
    )
    assert not dark.found
    assert bright.found
    assert bright.off_dB > bright.left_dB + 3.0
