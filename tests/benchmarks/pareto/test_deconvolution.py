from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from tests.benchmarks.pareto.deconvolution import (
    SIZES,
    TIERS,
    Deconvolutions,
    Deconvolved,
    deconv_rows,
    deconv_table,
    deconvolutions_of,
)
from tests.benchmarks.peers.lines import Line
from udccal.tiers import Tier

SMALL, LARGE = SIZES
GOOD = Deconvolutions(
    {(size, tier): Deconvolved(dB, 1.0) for size in SIZES for tier, dB in zip(TIERS, (30.0, 31.0, 34.0), strict=True)},
    Deconvolved(30.0, 1.5),
    Deconvolved(33.5, 60.0),
)


def changed(size: tuple[int, int], tier: Tier, dB: float = 40.0, seconds: float = 1.0) -> Deconvolutions:
    return replace(GOOD, ours={**GOOD.ours, (size, tier): Deconvolved(dB, seconds)})


def test_good_deconvolutions_pass() -> None:
    rows = deconv_rows(GOOD)
    assert len(rows) == 3 + 3
    assert all(row.ok for row in rows)


@pytest.mark.parametrize(
    ("found", "missed"),
    [
        (changed(SMALL, Tier.fast, dB=25.6), 0),
        (changed(SMALL, Tier.accurate, dB=math.nan), 2),
        (changed(LARGE, Tier.balanced, dB=30.4), 3),
        (changed(LARGE, Tier.balanced, seconds=1.6), 4),
        (replace(GOOD, floor=Deconvolved(math.nan, math.nan)), 4),
        (changed(LARGE, Tier.accurate, seconds=12.1), 5),
        (changed(LARGE, Tier.accurate, dB=32.9), 5),
    ],
)
def test_each_miss_is_told(found: Deconvolutions, missed: int) -> None:
    assert [index for index, row in enumerate(deconv_rows(found)) if not row.ok] == [missed]


def test_without_scico_the_rows_say_so_and_ask_for_the_picture_alone() -> None:
    alone = replace(changed(LARGE, Tier.accurate, dB=34.0, seconds=1e3), scico=None)
    row = deconv_rows(alone)[-1]
    assert row.ok
    assert "SCICO was not run" in row.name
    assert not deconv_rows(replace(changed(LARGE, Tier.accurate, dB=32.0), scico=None))[-1].ok
    assert "| not run |" in deconv_table(alone)
    assert "not run" not in deconv_table(GOOD)


def test_a_script_that_fails_has_no_numbers() -> None:
    failed = Deconvolved.of([Line.failure("deconv", "a", "no such file")])
    assert math.isnan(failed.dB)
    assert math.isnan(failed.seconds)


def test_works_that_are_absent_are_a_miss(tmp_path: Path) -> None:
    found = deconvolutions_of(tmp_path, tmp_path)
    assert found.scico is None
    assert not any(row.ok for row in deconv_rows(found))
