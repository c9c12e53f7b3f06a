"""What counts as an extreme that a fit has stood."""

from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks.extremes.case import WORST_Z, Outcome
from udccal.result import FitStatus


@pytest.mark.parametrize("status", [FitStatus.CONVERGED, FitStatus.ABSENT])
def test_a_result_within_its_error_bars_is_ok(status: FitStatus) -> None:
    assert Outcome(status, np.array([0.5, -WORST_Z]), True, "").ok


@pytest.mark.parametrize(
    "bad",
    [
        Outcome(FitStatus.CONVERGED, np.array([0.5, 1.1 * WORST_Z]), True, "a note"),
        Outcome(FitStatus.CONVERGED, np.array([np.nan]), True, ""),
        Outcome(FitStatus.CONVERGED, np.zeros(0), True, "a note"),  # nothing was judged
        Outcome(FitStatus.ABSENT, np.zeros(0), True, ""),
        Outcome(FitStatus.TOO_DARK, np.zeros(0), True, ""),
        Outcome(FitStatus.TOO_DARK, np.zeros(0), False, "More light."),
    ],
)
def test_what_none_has_judged_or_advised_is_not(bad: Outcome) -> None:
    assert not bad.ok


def test_a_named_status_with_advice_is_ok() -> None:
    assert Outcome(FitStatus.TOO_DARK, np.zeros(0), True, "More light.").ok
