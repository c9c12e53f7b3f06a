"""Frames in a window of an X server without a monitor, read from the server's own memory."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from tests.displays.virtual_screen import virtual_screen

pytestmark = pytest.mark.medium

# Shows a picture of 4 x 8 (left half red, right half green), says so, and shows it again with each line it is sent.
_SHOWS = """
import sys
import numpy as np
from udccal.live.sinks.protocol import RestoredFrame
from udccal.live.sinks.window import WindowSink

picture = np.zeros((4, 8, 3), np.uint8)
picture[:, :4, 0] = picture[:, 4:, 1] = 200
try:
    sink = WindowSink(sys.argv[1], 30.0)
    sink.open((4, 8))
    for _ in range(20):
        sink.write(RestoredFrame(picture, 0, 0))
    print("shown", flush=True)
    for _ in sys.stdin:
        sink.write(RestoredFrame(picture, 0, 0))
        print("shown", flush=True)
except Exception as error:
    print(error, flush=True)
else:
    sink.close()
"""


def shower(display: str, target: str) -> subprocess.Popen[str]:
    environment = os.environ | {"DISPLAY": display, "SDL_VIDEODRIVER": "x11"}
    return subprocess.Popen(
        [sys.executable, "-c", _SHOWS, target],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def test_a_monitor_is_filled_without_distortion() -> None:
    with virtual_screen("320x200x24") as screen, shower(screen.display, "0") as process:
        assert line(process) == "shown"
        pixels = screen.pixels().astype(int)
        process.communicate("")
    assert np.ptp(pixels[:20]) == 0  # 320 x 160 of 320 x 200 are the picture
    assert (pixels[30:170, :130] == (200, 0, 0)).all()
    assert (pixels[30:170, 190:] == (0, 200, 0)).all()


def test_a_window_has_the_pictures_size_and_ends_when_nobody_shows() -> None:
    with virtual_screen("320x200x24") as screen, shower(screen.display, "mirror") as process:
        assert line(process) == "shown"
        red = (screen.pixels() == (200, 0, 0)).all(axis=-1).sum()
        process.communicate("")
    assert red == 16


def test_what_cannot_be_shown_is_said() -> None:
    with virtual_screen("320x200x24") as screen, shower(screen.display, "7") as process:
        assert line(process).startswith("Expected a monitor with number 7, found monitors 0 to 0.")
    with shower(":77", "0") as process:
        assert line(process).startswith("Expected a desktop to open a window on, found none")
