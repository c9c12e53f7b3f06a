from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.pareto.groups import Group
from tests.benchmarks.pareto.made_runs import DB, MS, good_runs, made
from tests.benchmarks.pareto.plans import (
    BUDGETS_MS,
    Choice,
    Expected,
    Plans,
    bias_dB,
    choice_rows,
    error_rows,
    regret_dB,
)
from udccal.tiers import Tier

RUNS = good_runs()
SCENES = sorted({run.scene for run in RUNS})
# The best tier within each budget, by the times of the runs.
BEST = dict(zip(BUDGETS_MS, (Tier.fast, Tier.balanced, Tier.balanced, Tier.accurate), strict=True))


def plans(chosen: Mapping[float | None, Tier | None] = BEST, dB: float = 0.0, slower: float = 1.0) -> Plans:
    """What a planner says that errs by so many dB and by a factor of time."""
    return Plans(
        tuple(Choice(scene, budget, tier) for scene in SCENES for budget, tier in chosen.items()),
        tuple(Expected(scene, tier, DB[tier] + dB, slower * MS[tier]) for scene in SCENES for tier in Tier),
    )


def test_a_planner_that_is_right_passes() -> None:
    rows = choice_rows(plans(), RUNS) + error_rows(plans(), RUNS)
    assert len(rows) == 5 + 8 + 4
    assert all(row.ok for row in rows)
    assert bias_dB(plans(dB=-0.4), RUNS, Tier.fast) == pytest.approx(-0.4)


@pytest.mark.parametrize("budget", BUDGETS_MS)
def test_a_planner_that_chooses_a_worse_tier_regrets_it(budget: float | None) -> None:
    rows = choice_rows(plans({**BEST, budget: Tier.preview}), RUNS)
    assert [row.ok for row in rows] == [each != budget for each in BUDGETS_MS] + [True]


def test_a_planner_that_breaks_a_budget_gains_nothing_and_is_told() -> None:
    rows = choice_rows(plans({**BEST, 40.0: Tier.accurate}), RUNS)
    assert rows[0].value == 0.0
    assert not rows[-1].ok


def test_a_planner_that_refuses_what_can_be_done_regrets_the_picture() -> None:
    rows = choice_rows(plans({**BEST, 200.0: None}), RUNS)
    assert rows[1].value == pytest.approx(DB[Tier.balanced] - 20.0)
    assert not rows[1].ok


def test_to_refuse_is_right_where_no_tier_keeps_the_budget() -> None:
    runs = {tier: made(Group.nineteen, tier, "a") for tier in Tier}
    assert regret_dB(Choice("a", 1.0, None), runs, MS) == 0.0
    assert regret_dB(Choice("a", 5.0, None), runs, MS) == pytest.approx(5.0)


def test_expectations_that_are_off_are_told() -> None:
    assert [row.ok for row in error_rows(plans(dB=-0.6), RUNS)] == [False] * 8 + [True] * 4
    assert [row.ok for row in error_rows(plans(slower=0.7), RUNS)] == [True] * 8 + [False] * 4


def test_errors_of_opposite_signs_do_not_cancel() -> None:
    wrong = tuple(
        replace(each, dB=each.dB + (3.0 if each.scene.startswith("a") else -3.0)) for each in plans().expected
    )
    assert not any(row.ok for row in error_rows(Plans(plans().choices, wrong), RUNS)[:8])


def test_a_planner_that_expects_nothing_is_told() -> None:
    unknown = tuple(replace(each, dB=float("nan")) for each in plans().expected)
    rows = error_rows(Plans(plans().choices, unknown), RUNS)
    assert np.isnan(rows[0].value)
    assert not any(row.ok for row in rows[:8])
