"""What each event of the desktop means for the picture on screen, under SDL's driver without a screen."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

pygame = pytest.importorskip("pygame", reason="needs pygame-ce: pip install 'udccal[window]'")

from udccal.displays import panel_window  # noqa: E402
from udccal.displays.monitors import choose_monitor, describe, seen_monitors  # noqa: E402
from udccal.displays.panel_window import PanelWindow  # noqa: E402
from udccal.displays.protocol import PanelSize  # noqa: E402
from udccal.displays.window_messages import Monitor  # noqa: E402
from udccal.errors import DisplayError  # noqa: E402

LEFT, RIGHT = Monitor(0, 0, 0, 1920, 1080, 60), Monitor(1, 1920, 0, 1920, 1080, 0)
PANEL = PanelSize(1920, 1080)


def post(kind: int) -> None:
    pygame.event.post(pygame.event.Event(kind))


@pytest.fixture
def monitor(monkeypatch: pytest.MonkeyPatch) -> Iterator[Monitor]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    post(pygame.WINDOWEXPOSED)  # this driver sends none
    yield seen_monitors()[0]
    pygame.display.quit()


def shown_window(monitor: Monitor, alone: bool) -> PanelWindow:
    window = PanelWindow(monitor, alone)
    window.show(np.full((monitor.rows, monitor.columns, 3), 7, np.uint8), 0.0)
    window.check()
    return window


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (pygame.WINDOWMINIMIZED, "minimised or hidden"),
        (pygame.WINDOWHIDDEN, "minimised or hidden"),
        (pygame.WINDOWFOCUSLOST, "covers it on the only monitor"),
        (pygame.WINDOWCLOSE, "closed"),
        (pygame.QUIT, "closed"),
    ],
    ids=["minimised", "hidden", "focus lost", "close", "quit"],
)
@pytest.mark.parametrize("how", ["check", "show"])
def test_a_loss_is_said_by_whichever_call_comes_first(monitor: Monitor, kind: int, said: str, how: str) -> None:
    window = shown_window(monitor, alone=True)
    post(kind)
    with pytest.raises(DisplayError, match=f"stay on screen, found that .*{said}"):
        window.check() if how == "check" else window.show(None, 0.0)
    window.close()


def test_a_loss_is_said_once_and_a_window_that_is_back_shows_again(monitor: Monitor) -> None:
    window = shown_window(monitor, alone=True)
    post(pygame.WINDOWMINIMIZED)
    with pytest.raises(DisplayError):
        window.check()
    window.check()
    with pytest.raises(DisplayError, match="not on screen"):
        window.show(None, 0.0)
    post(pygame.WINDOWRESTORED)
    window.show(None, 0.0)
    window.check()
    window.close()


def test_a_closed_window_stays_closed(monitor: Monitor) -> None:
    window = shown_window(monitor, alone=True)
    post(pygame.WINDOWCLOSE)
    for _ in range(2):
        with pytest.raises(DisplayError, match="it was closed"):
            window.show(None, 0.0)
    window.close()


def test_a_person_may_work_on_another_monitor(monitor: Monitor) -> None:
    window = shown_window(monitor, alone=False)
    post(pygame.WINDOWFOCUSLOST)
    window.check()
    window.close()


def test_a_window_of_another_size_than_the_monitor_is_noticed(monitor: Monitor) -> None:
    window = shown_window(monitor, alone=True)
    window._window.set_windowed()
    window._window.size = (640, 480)
    with pytest.raises(DisplayError, match="moved or resized"):
        window.check()
    with pytest.raises(DisplayError, match="640 x 480 pixels"):
        window.show(None, 0.0)
    window.close()


def test_a_window_that_does_not_appear_is_refused_in_bounded_time(
    monitor: Monitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panel_window, "_OPENING_S", 0.2)
    pygame.event.clear()
    start = time.monotonic()
    with pytest.raises(DisplayError, match="fill monitor 0, found that it is not on screen"):
        PanelWindow(monitor, alone=True)
    assert time.monotonic() - start < 5


def test_a_picture_that_is_covered_over_and_over_is_refused_in_bounded_time(
    monitor: Monitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panel_window, "_SETTLING_S", 0.3)
    window = shown_window(monitor, alone=True)
    pygame.time.set_timer(pygame.WINDOWEXPOSED, 20)
    with pytest.raises(DisplayError, match="covered repeatedly"):
        window.show(None, 0.2)
    pygame.time.set_timer(pygame.WINDOWEXPOSED, 0)
    window.close()


def test_the_monitor_must_be_there_of_the_panels_size_and_not_mirrored(monitor: Monitor) -> None:
    assert choose_monitor([LEFT, RIGHT], 1, PANEL) == RIGHT
    assert choose_monitor([LEFT, Monitor(1, 0, 0, 1920, 1080, 60)], 0, PANEL) == LEFT
    for monitors, index, said in (
        ([], 0, "found no monitor"),
        ([LEFT], 1, "found monitor 0: 1920 x 1080"),
        ([LEFT], -1, "found monitor 0: 1920 x 1080"),
        ([LEFT, Monitor(1, 1920, 0, 1280, 720, 60)], 1, "monitor 1: 1280 x 720"),
        ([LEFT, Monitor(1, 0, 0, 1920, 1080, 60)], 1, "side by side, not mirrored"),
    ):
        with pytest.raises(DisplayError, match=said):
            choose_monitor(monitors, index, PANEL)
    assert describe([LEFT, RIGHT]) == ("monitor 0: 1920 x 1080 at (0, 0), 60 Hz; monitor 1: 1920 x 1080 at (1920, 0)")
