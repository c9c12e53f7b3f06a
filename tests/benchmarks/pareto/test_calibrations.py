"""The trade in calibration: captures that are asked for are taken, and a worse profile is seen to be worse."""

from __future__ import annotations

from typing import get_args

import pytest
from pydantic import ValidationError

from tests.benchmarks.pareto.calibrations import ALL, FEWER, Fewer, FromFewer, fewer_table
from udccal.planning.state import nominal_state
from udccal.planning.steps import Cost
from udccal.rig import load_rig
from udccal.sessions.schema import TermName


def frames(fewer: Fewer) -> int:
    state = nominal_state(fewer.of(load_rig("lg55-reduced")))
    return sum(state.cost(term).frames for term in get_args(TermName))


@pytest.mark.medium
def test_each_set_takes_fewer_frames() -> None:
    assert FEWER[0] is ALL
    assert all(frames(fewer) < frames(ALL) for fewer in FEWER[1:])


@pytest.mark.parametrize("changes", [{"flat": 6}, {"flats": 0}], ids=str)
def test_captures_that_no_rig_can_ask_for_are_refused(changes: dict[str, int]) -> None:
    with pytest.raises(ValidationError):
        Fewer(changes).of(load_rig("lg55-reduced"))


def test_the_table_compares_with_the_first() -> None:
    found = [
        FromFewer(ALL, Cost(900, 60.0, 1), (30.0, 40.0), ()),
        FromFewer(FEWER[1], Cost(90, 6.0, 1), (29.0, 38.0), ("psf",)),
    ]
    *_, full, fewer = fewer_table(found).splitlines()
    assert full == "| as the rig asks | 900 | 60 | +0.00 | +0.00 |  |"
    assert fewer == "| flats: 6 | 90 | 6 | -1.50 | -2.00 | psf |"
