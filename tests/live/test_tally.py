from __future__ import annotations

import numpy as np
import pytest

from udccal.live.durations import Durations, Spread
from udccal.live.tally import Stage, Tally


def test_percentiles_are_at_most_one_percent_too_large() -> None:
    seconds = np.random.default_rng(1).lognormal(-4, 1, 10_000)
    durations = Durations()
    for value in seconds:
        durations.add(float(value))
    found = durations.spread()
    for percent, value in ((50, found.p50), (95, found.p95), (99, found.p99)):
        true_ms = 1e3 * float(np.percentile(seconds, percent, method="inverted_cdf"))
        assert value is not None
        assert 1.0 <= value / true_ms <= 1.01 + 1e-9


def test_no_duration_is_too_short_or_too_long_and_none_is_no_number() -> None:
    assert Durations().spread() == Spread(None, None, None)
    durations = Durations()
    durations.add(0.0)
    assert durations.spread().p99 == pytest.approx(1e-2)
    durations.add(1e9)
    assert durations.spread().p99 == pytest.approx(1e5, rel=0.02)


def test_seconds_begin_anew_and_the_whole_goes_on() -> None:
    tally = Tally()
    for _ in range(2):
        tally.captured(4)
        tally.dropped(Stage.ACQUISITION)
        tally.dropped(Stage.RESTORATION, 2)
        tally.took(Stage.RESTORATION, 0.010)
        tally.without_panel_picture()
        tally.written(0.030, late_hook=True)
        figures = tally.second()
        assert (figures.captured, figures.written, figures.late_hooks) == (4, 1, 1)
        assert (figures.dropped_by_camera, figures.dropped_before_restoration, figures.dropped_before_output) == (
            1,
            2,
            0,
        )
        assert figures.without_panel_picture == 1
        assert figures.latency_ms.p50 == pytest.approx(30, rel=0.01)
    whole = tally.whole()
    assert (whole.captured, whole.written, whole.dropped) == (8, 2, 6)
    assert whole.without_panel_picture == 2
    assert tally.second().restoration_ms == Spread(None, None, None)
