"""The judge of a full-size frame's cost, on costs that never were."""

from __future__ import annotations

from dataclasses import replace

from tests.benchmarks.frame_cost import Cost
from tests.benchmarks.full_size import rows_of
from udccal.tiers import Tier

FAST = Cost(3.0, 30.0, 600.0)
GOOD = dict.fromkeys(Tier, FAST)


def missed(first: Cost = FAST, **later: Cost) -> list[str]:
    return [row.name for row in rows_of(first, GOOD | {Tier(name): cost for name, cost in later.items()}) if not row.ok]


def test_good_costs_pass() -> None:
    assert missed() == []


def test_each_fault_is_seen() -> None:
    assert missed(preview=replace(FAST, frame_ms=34.0)) == ["preview, a frame"]
    assert missed(balanced=replace(FAST, frame_ms=float("nan"))) == ["balanced, a frame"]
    assert missed(accurate=replace(FAST, frame_ms=20.1e3)) == ["accurate, a frame"]
    assert missed(replace(FAST, start_s=31.0)) == ["fast, first start to first picture"]
    assert missed(fast=Cost(4.1, 151.0, 701.0)) == [
        "fast, a frame",
        "fast, peak memory of a process that does nothing else",
        "fast, second start to first picture",
    ]
