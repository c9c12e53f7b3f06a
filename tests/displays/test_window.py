"""Pictures through the window, read back from the memory of a virtual screen."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError

import numpy as np
import pytest
from jaxtyping import UInt8

from tests.displays.virtual_screen import VirtualScreen, virtual_screen
from udccal.displays import window, window_link
from udccal.displays.protocol import Display, PanelSize
from udccal.displays.window import WindowDisplay, list_monitors
from udccal.displays.window_messages import Monitor
from udccal.errors import DisplayError

pytest.importorskip("pygame", reason="needs pygame-ce: pip install 'udccal[window]'")
pytestmark = pytest.mark.timeout(120)

SMALL = PanelSize(320, 200)
SETTLE_S = 0.05  # a virtual screen has no delay

OTHER_WINDOW = """
import pygame
pygame.display.init()
window = pygame.Window("other", (60, 40), position=(10, 10))
while pygame.event.wait().type != pygame.WINDOWEXPOSED:
    pass
window.get_surface().fill("red")
window.flip()
print("there", flush=True)
while True:
    pygame.event.wait()
"""
SHOWN_FOR_EVER = """
import sys, time
import numpy as np
from udccal.displays.protocol import PanelSize
from udccal.displays.window import WindowDisplay
with WindowDisplay(0, PanelSize(320, 200), 0.05) as display:
    display.show(np.full((200, 320, 3), 200, np.uint8))
    print("shown", flush=True)
    time.sleep(100)
"""


def noise(size: PanelSize, seed: int = 0) -> UInt8[np.ndarray, "rows columns 3"]:
    return np.random.default_rng(seed).integers(0, 256, (size.rows, size.columns, 3), dtype=np.uint8)


def differing(seen: np.ndarray, wanted: np.ndarray) -> int:
    assert seen.shape == wanted.shape
    return int((seen != wanted).any(axis=-1).sum())


def eventually(true: Callable[[], bool], within_s: float = 10.0) -> bool:
    end = time.monotonic() + within_s
    while not true() and time.monotonic() < end:
        time.sleep(0.05)
    return true()


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Iterator[VirtualScreen]:
    """A small screen that SDL finds by itself."""
    with virtual_screen("320x200x24") as server:
        monkeypatch.setenv("DISPLAY", server.display)
        monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
        yield server


@contextmanager
def other_window() -> Iterator[None]:
    """A window of another program, on top."""
    with subprocess.Popen([sys.executable, "-c", OTHER_WINDOW], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            assert any("there" in line for line in process.stdout)
            yield
        finally:
            process.kill()


@pytest.mark.parametrize("size", [PanelSize(1920, 1080), SMALL, PanelSize(202, 130)], ids=str)
def test_every_pixel_is_shown_and_off_is_black(size: PanelSize, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = noise(size, 1), noise(size, 2)
    altered = second.copy()
    altered[size.rows // 2, size.columns // 3, 1] ^= 1
    with virtual_screen(f"{size.columns}x{size.rows}x24") as server:
        monkeypatch.setenv("DISPLAY", server.display)
        with WindowDisplay(0, size, SETTLE_S) as display:
            assert isinstance(display, Display)
            assert display.size == size
            assert server.pixels().max() == 0  # nothing of the desktop, no pointer
            display.show(first)
            assert differing(server.pixels(), first) == 0
            display.show(second[:, ::-1])  # not contiguous in memory
            assert differing(server.pixels(), second[:, ::-1]) == 0
            display.show(altered)
            assert differing(server.pixels(), altered) == 0
            assert differing(server.pixels(), second) == 1  # one count in one channel is seen
            display.check()
            display.off()
            assert server.pixels().max() == 0


@pytest.mark.medium
def test_waits_as_long_as_it_is_told(screen: VirtualScreen) -> None:
    seconds = []
    for settle_s in (0.0, 0.8):
        with WindowDisplay(0, SMALL, settle_s) as quick:
            start = time.monotonic()
            quick.show(noise(SMALL))
            seconds.append(time.monotonic() - start)
    assert seconds[1] >= 0.8 + 3 / 24  # three refreshes of a monitor that does not tell its rate
    assert seconds[1] - seconds[0] > 0.5


def test_monitors_are_listed_and_the_chosen_one_must_run_at_the_panels_size(screen: VirtualScreen) -> None:
    assert list_monitors() == (Monitor(0, 0, 0, 320, 200, 0),)
    with (
        pytest.raises(DisplayError, match=r"the panel's 1920 x 1080 pixels, found monitor 0: 320 x 200 at \(0, 0\)"),
        WindowDisplay(0, PanelSize(1920, 1080)),
    ):
        pass
    with pytest.raises(DisplayError, match="number 1, found monitor 0: 320 x 200"), WindowDisplay(1, SMALL):
        pass
    assert screen.pixels().max() == 0


@pytest.mark.medium
def test_two_screens_only_the_chosen_one_lights_up(monkeypatch: pytest.MonkeyPatch) -> None:
    large, picture = PanelSize(400, 300), noise(SMALL)
    with virtual_screen("320x200x24", "400x300x24") as server:
        monkeypatch.setenv("DISPLAY", server.display)
        assert [(m.columns, m.rows) for m in list_monitors()] == [(320, 200), (400, 300)]
        with WindowDisplay(0, SMALL, SETTLE_S) as display:
            display.show(picture)
            assert differing(server.pixels(0), picture) == 0
            assert server.pixels(1).max() == 0
        # Screens of X, unlike monitors of one screen, begin at one place, and SDL cannot put a window on the second.
        with pytest.raises(DisplayError, match="a position of its own"), WindowDisplay(1, large):
            pass
        assert server.pixels(1).max() == 0


def test_a_desktop_of_few_colours_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with virtual_screen("320x200x16") as server:
        monkeypatch.setenv("DISPLAY", server.display)
        with pytest.raises(DisplayError, match="24 bits per pixel, found 16"), WindowDisplay(0, SMALL):
            pass


def test_being_covered_is_noticed_said_once_and_mended_by_showing_again(screen: VirtualScreen) -> None:
    picture = noise(SMALL)
    with WindowDisplay(0, SMALL, SETTLE_S) as display:
        display.show(picture)
        with other_window():
            assert differing(screen.pixels(), picture) > 1000
            with pytest.raises(DisplayError, match="another window"):
                display.check()
        assert eventually(lambda: differing(screen.pixels(), picture) == 0)  # drawn anew by itself
        with pytest.raises(DisplayError, match="covered it for a while"):
            display.show(picture)
        display.show(picture)
        display.check()
        assert differing(screen.pixels(), picture) == 0


def test_ctrl_c_does_not_reach_the_window(screen: VirtualScreen) -> None:
    with WindowDisplay(0, SMALL, SETTLE_S) as display:
        assert display._link is not None
        display._link._process.send_signal(signal.SIGINT)
        display.show(noise(SMALL))
        assert differing(screen.pixels(), noise(SMALL)) == 0


def test_the_picture_does_not_outlive_the_program(screen: VirtualScreen) -> None:
    with subprocess.Popen([sys.executable, "-c", SHOWN_FOR_EVER], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "shown\n"
            assert screen.pixels().min() == 200
        finally:
            process.kill()
        # Nothing but the pointer is seen then.
        assert eventually(lambda: (screen.pixels() == 0).mean() > 0.99)


def test_a_dead_screen_is_an_error(screen: VirtualScreen) -> None:
    with WindowDisplay(0, SMALL, SETTLE_S) as display:
        display.off()
        screen.process.kill()
        screen.process.wait()
        with pytest.raises(DisplayError, match=r"its process ended|Expected a desktop"):
            display.show(noise(SMALL))
        with pytest.raises(DisplayError, match=r"its process ended|found it closed"):
            display.check()


@pytest.mark.medium
def test_a_silent_window_is_an_error_in_bounded_time(screen: VirtualScreen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "_ANSWER_S", 0.2)
    monkeypatch.setattr(window_link, "_END_S", 0.2)
    start, picture = time.monotonic(), noise(SMALL)
    with WindowDisplay(0, SMALL, SETTLE_S) as display:
        assert display._link is not None
        os.kill(display._link._process.pid, signal.SIGSTOP)
        with pytest.raises(DisplayError, match=r"answer within 0\.25 s, found no answer"):
            display.off()
        with pytest.raises(DisplayError, match="its process ended"):
            display.check()
        monkeypatch.setattr(window, "_ANSWER_S", 20.0)
        display.show(picture)  # in a new window, with no late answer of the old one between
        np.testing.assert_array_equal(screen.pixels(), picture)
    assert time.monotonic() - start < 30


@pytest.mark.parametrize("driver", ["x11", "dummy", "offscreen"])
def test_without_a_desktop_it_says_so(driver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    monkeypatch.setenv("DISPLAY", ":987654")
    with pytest.raises(DisplayError, match="Expected a desktop to show a window on"):
        list_monitors()


def test_without_the_package_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(window_link, "version", absent)
    with pytest.raises(DisplayError, match=r"pip install 'udccal\[window\]'"):
        list_monitors()


def test_refuses_wrong_pictures_waits_and_use_when_closed(screen: VirtualScreen) -> None:
    with WindowDisplay(0, SMALL, SETTLE_S) as display:
        display.show(noise(SMALL))
        with pytest.raises(DisplayError, match="320 x 200 pixels, found 200 x 320"):
            display.show(np.zeros((320, 200, 3), np.uint8))
        assert differing(screen.pixels(), noise(SMALL)) == 0
    with pytest.raises(DisplayError, match="'with' statement"):
        display.off()
    with pytest.raises(DisplayError, match="from 0 to 60 s"):
        WindowDisplay(0, SMALL, -1.0)
