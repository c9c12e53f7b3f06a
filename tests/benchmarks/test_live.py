"""The judge of a live run, on runs that never were."""

from __future__ import annotations

import math
from dataclasses import replace

from tests.benchmarks.live import Measured, judged

GOOD = Measured(captured=18_000, dropped=100, latency_p95_ms=50.0, memory_MiB=(400.0, 410.0, 395.0))


def verdicts(measured: Measured) -> list[bool]:
    return [row.ok for row in judged(measured)]


def test_a_good_run_passes() -> None:
    assert verdicts(GOOD) == [True, True, True]


def test_each_fault_is_seen() -> None:
    assert verdicts(replace(GOOD, dropped=200)) == [False, True, True]
    assert verdicts(replace(GOOD, latency_p95_ms=67.0)) == [True, False, True]
    assert verdicts(replace(GOOD, memory_MiB=(400.0, 421.0))) == [True, True, False]
    assert verdicts(replace(GOOD, memory_MiB=(400.0, 379.0))) == [True, True, False]


def test_a_run_that_measured_nothing_misses() -> None:
    assert verdicts(Measured(0, 0, math.nan, ())) == [False, False, False]
