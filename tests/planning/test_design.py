"""The search on costs and sigmas that are known in closed form."""

from __future__ import annotations

import math

import pytest

from udccal.planning.design import DESIGN_VARIABLES, Objective, cheapest, worthwhile
from udccal.planning.steps import Cost
from udccal.rig import Captures
from udccal.sessions.schema import TermName


def wire(floor: float = 0.0) -> Objective:
    return Objective(
        "wire",
        lambda captures: math.sqrt(floor**2 + 1 / captures.flats),
        lambda captures: Cost(captures.flats, 0.01 * captures.flats, 2),
    )


def psf(dear: str) -> Objective:
    """Positions and shifts give the same information; one of them takes ten times as long."""

    def cost(captures: Captures) -> Cost:
        positions, shifts = captures.psf_columns * captures.psf_rows, captures.psf_shifts
        seconds = 10.0 * positions + shifts if dear == "positions" else positions + 10.0 * shifts
        return Cost(positions * shifts, seconds, positions * shifts)

    def sigma(captures: Captures) -> float:
        return 1 / math.sqrt(captures.psf_columns * captures.psf_rows * captures.psf_shifts)

    return Objective("psf", sigma, cost)


@pytest.mark.parametrize("target", [0.5, 0.123, 0.0421, 0.01])
def test_as_few_flats_as_reach_the_target(target: float) -> None:
    found = cheapest(wire(), Captures(), target)
    assert found is not None
    assert found.flats == max(2, math.ceil(1 / target**2 - 1e-9))
    assert found == Captures(flats=found.flats)


def test_what_is_cheap_is_added() -> None:
    dear_positions, dear_shifts = (cheapest(psf(dear), Captures(), 0.1) for dear in ("positions", "shifts"))
    assert dear_positions is not None
    assert dear_shifts is not None
    for captures in (dear_positions, dear_shifts):
        assert captures.psf_columns * captures.psf_rows * captures.psf_shifts >= 100
    assert dear_positions.psf_shifts > 3 * dear_shifts.psf_shifts
    assert dear_positions.psf_columns * dear_positions.psf_rows < dear_shifts.psf_columns * dear_shifts.psf_rows


def test_nothing_can_be_taken_away_from_a_plan() -> None:
    objective = psf("positions")
    found = cheapest(objective, Captures(), 0.087)
    assert found is not None
    for variable in DESIGN_VARIABLES["psf"]:
        if variable.of(found) > variable.least:
            assert objective.sigma(variable.set(found, variable.of(found) - 1)) > 0.087


def test_the_same_question_has_the_same_answer_whatever_the_rig_had_before() -> None:
    first, second = (cheapest(psf("shifts"), Captures(psf_shifts=shifts), 0.03) for shifts in (2, 60))
    assert first == second is not None


@pytest.mark.parametrize("target", [0.3, 0.29])
def test_a_target_at_or_below_the_floor_is_not_reached(target: float) -> None:
    assert cheapest(wire(floor=0.3), Captures(), target) is None


def test_a_sigma_that_nothing_lowers_ends_the_search() -> None:
    stuck = Objective("psf", lambda captures: 1.0, lambda captures: Cost(1, 1.0, 1))
    assert cheapest(stuck, Captures(), 0.5) is None
    assert worthwhile(stuck, Captures()) == []


def test_captures_too_few_for_a_fit_are_added_to() -> None:
    def sigma(captures: Captures) -> float:
        return math.inf if captures.board_views < 7 else 1 / captures.board_views

    objective = Objective(
        "geometry", sigma, lambda captures: Cost(1, float(captures.board_views), captures.board_views)
    )
    assert cheapest(objective, Captures(), 0.15) == Captures(board_views=7)


@pytest.mark.parametrize("term", list(DESIGN_VARIABLES))
def test_every_least_design_is_a_valid_one_and_can_grow(term: TermName) -> None:
    variables = DESIGN_VARIABLES[term]

    def sigma(captures: Captures) -> float:
        return 1 / math.prod(variable.of(captures) for variable in variables)

    growing = Objective(term, sigma, lambda captures: Cost(1, 1 / sigma(captures), 1))
    least = cheapest(growing, Captures(), 1.0)
    assert least is not None
    assert Captures.model_validate(least.model_dump()) == least
    steps_up = [one.setting for one in worthwhile(growing, least)]
    assert [one.name for one in steps_up] == [variable.name for variable in variables]
    for variable, setting in zip(variables, steps_up, strict=True):
        assert setting.planned > setting.before == variable.least
        Captures.model_validate(variable.set(least, setting.planned).model_dump())
