from __future__ import annotations

import pytest

from udccal.displays.protocol import PanelSize
from udccal.displays.window_messages import Monitor
from udccal.doctor.displays import monitor_finding
from udccal.doctor.finding import Status
from udccal.errors import DisplayError

DESK, PANEL = Monitor(0, 0, 0, 1280, 720, 60), Monitor(1, 1280, 0, 1920, 1080, 0)
SIZE = PanelSize(1920, 1080)


def both() -> tuple[Monitor, ...]:
    return DESK, PANEL


def missing() -> tuple[Monitor, ...]:
    raise DisplayError("Expected the package, found none. Install it: pip install 'udccal[window]'")


def test_monitors_are_listed() -> None:
    for size, monitor in ((None, None), (SIZE, None), (SIZE, 1), (None, 0)):
        finding = monitor_finding(size, monitor, both)
        assert finding.status is Status.OK
        assert finding.found == "0: 1280 x 720 at (0, 0), 60 Hz; 1: 1920 x 1080 at (1280, 0)"


@pytest.mark.parametrize(
    ("size", "monitor", "status", "said"),
    [
        (SIZE, 0, Status.PROBLEM, "Monitor 0 does not run at the panel's 1920 x 1080"),
        (SIZE, 2, Status.PROBLEM, "no monitor 2"),
        (None, -1, Status.PROBLEM, "no monitor -1"),
        (PanelSize(3840, 2160), None, Status.NOTE, "No monitor runs at the panel's 3840 x 2160"),
        (PanelSize(3840, 2160), 1, Status.PROBLEM, "Monitor 1 does not run"),
    ],
    ids=str,
)
def test_the_panel_must_be_among_them(size: PanelSize | None, monitor: int | None, status: Status, said: str) -> None:
    finding = monitor_finding(size, monitor, both)
    assert finding.status is status
    assert said in finding.advice


def test_no_window_is_a_note_and_a_problem_only_when_asked_for() -> None:
    assert monitor_finding(SIZE, None, missing).status is Status.NOTE
    asked = monitor_finding(SIZE, 0, missing)
    assert asked.status is Status.PROBLEM
    assert "pip install 'udccal[window]'" in asked.advice
