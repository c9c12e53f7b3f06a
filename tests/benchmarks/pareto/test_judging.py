from __future__ import annotations

from dataclasses import replace

import pytest

from tests.benchmarks.pareto.groups import Group
from tests.benchmarks.pareto.judging import gain_rows, loss_rows, order_rows, time_rows
from tests.benchmarks.pareto.made_runs import good_runs, made
from tests.benchmarks.pareto.runs import Run
from udccal.tiers import Tier

FULL = 2048 * 1536


def changed(runs: list[Run], tier: Tier, dB: float, group: Group | None = None, scene: str = "") -> list[Run]:
    """Runs with other dB at a tier: of a group, or of a scene."""
    return [
        replace(run, after_dB=dB)
        if run.tier is tier and (group is None or run.group is group) and run.scene.startswith(scene)
        else run
        for run in runs
    ]


def test_good_runs_pass_every_row() -> None:
    runs = good_runs()
    rows = time_rows(runs, FULL) + order_rows(runs) + gain_rows(runs) + loss_rows(runs)
    assert len(rows) == 4 + 6 + 4 + 3
    assert all(row.ok for row in rows)


@pytest.mark.parametrize("tier", list(Tier))
def test_a_slow_tier_is_told(tier: Tier) -> None:
    runs = [replace(run, ms=1e3 * run.ms) if run.tier is tier else run for run in good_runs()]
    assert [row.ok for row in time_rows(runs, FULL)] == [each is not tier for each in Tier]


def test_the_limit_of_time_follows_the_sensor_and_says_so() -> None:
    runs = good_runs()
    rows = time_rows(runs, FULL // 4)
    assert [row.limit for row in rows] == [8.25, 37.5, 100.0, 5.0]
    assert all("limit x 0.25" in row.name for row in rows)
    assert not time_rows(runs, FULL // 64)[1].ok


def test_times_of_dark_frames_do_not_count_but_missing_ones_do() -> None:
    runs = [*good_runs(), *(made(Group.dark, Tier.fast, str(index), ms=1e6) for index in range(99))]
    assert all(row.ok for row in time_rows(runs, FULL))
    assert not any(row.ok for row in time_rows(runs[-99:], FULL))


@pytest.mark.parametrize("group", [Group.nineteen, Group.fine])
def test_a_tier_that_is_worse_than_the_one_before_is_told(group: Group) -> None:
    rows = order_rows(changed(good_runs(), Tier.balanced, 30.0, group))
    assert [row.name for row in rows if not row.ok] == [f"{group}: mean dB of balanced - fast (at least)"]


@pytest.mark.parametrize(("tier", "dB"), [(Tier.balanced, 31.6), (Tier.accurate, 32.9)])
def test_a_tier_that_gains_too_little_is_told_in_each_group(tier: Tier, dB: float) -> None:
    rows = gain_rows(changed(good_runs(), tier, dB))
    assert [row.ok for row in rows] == [str(tier) not in row.name for row in rows]


def test_one_spoilt_scene_of_any_group_is_told_by_its_name() -> None:
    dark = [made(Group.dark, tier, "cellar") for tier in Tier]
    rows = loss_rows(changed(good_runs() + dark, Tier.accurate, 24.6, scene="cellar"))
    assert [row.ok for row in rows] == [True, True, False]
    assert "cellar, dark: usual" in rows[2].name
    assert all(row.ok for row in loss_rows(changed(good_runs() + dark, Tier.accurate, 24.8, scene="cellar")))


def test_a_scene_whose_dB_are_no_number_is_a_spoilt_one() -> None:
    rows = loss_rows(changed(good_runs(), Tier.fast, float("nan"), scene="b"))
    assert [row.ok for row in rows] == [False, True, True]


@pytest.mark.parametrize("absent", [Tier.preview, Tier.accurate])
def test_a_tier_that_did_not_run_is_refused(absent: Tier) -> None:
    with pytest.raises(ValueError, match="Expected a run of"):
        loss_rows([run for run in good_runs() if run.tier is not absent])
