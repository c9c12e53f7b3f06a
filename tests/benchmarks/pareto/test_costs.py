"""Starts, growth and memory."""

from __future__ import annotations

import mmap
import sys

import pytest

from tests.benchmarks.memory import peak_MiB, reset_peak
from tests.benchmarks.pareto.exponents import Growth, growth_rows
from tests.benchmarks.pareto.starts import Start, start_rows, to_first_line_s
from udccal.tiers import Tier


def test_costs_in_proportion_pass_and_steeper_ones_are_told() -> None:
    sizes = (1.0, 2.0, 4.0)
    rows = growth_rows([Growth("even", sizes, (3.0, 6.0, 12.0)), Growth("square", sizes, (1.0, 4.0, 16.0))])
    assert [row.value for row in rows] == pytest.approx([1.0, 2.0])
    assert [row.ok for row in rows] == [True, False]


def test_one_size_tells_nothing_of_growth() -> None:
    with pytest.raises(ValueError, match="two sizes"):
        growth_rows([Growth("tiles", (4.0, 4.0), (1.0, 1.0))])


def test_each_late_start_is_told() -> None:
    rows = start_rows([Start(Tier.preview, 31.0, 2.9), Start(Tier.fast, 29.0, 4.1)])
    assert [row.ok for row in rows] == [True, False, False, True]


def test_the_start_of_a_program_lasts_until_it_speaks() -> None:
    script = "import time; time.sleep(0.2); print('restored', flush=True); time.sleep(2)"
    assert 0.2 < to_first_line_s([sys.executable, "-c", script], {}) < 2.0


@pytest.mark.parametrize(
    "script", ["pass", "raise SystemExit(3)", "print('restored', flush=True); raise SystemExit(3)"]
)
def test_a_program_that_fails_has_no_start(script: str) -> None:
    with pytest.raises(RuntimeError, match="to restore a frame"):
        to_first_line_s([sys.executable, "-c", script], {})


@pytest.mark.skipif(sys.platform != "linux", reason="peaks of memory are read from /proc")
def test_a_peak_of_memory_is_seen_and_set_back() -> None:
    reset_peak()
    before = peak_MiB()
    # Pages of their own, which go back to the system at once; an array may stay within the heap.
    with mmap.mmap(-1, 32 * 2**20) as pages:
        pages.write(bytes(range(256)) * 2**17)
    assert 25 < peak_MiB() - before < 100
    reset_peak()
    assert peak_MiB() - before < 16
