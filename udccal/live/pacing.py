"""Frames at the pace of a clock, for cameras that have none: simulated frames and files."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from udccal.cameras.protocol import Camera, Frame

# A camera is asked for this many frames at a time, since none can be asked for all that will come.
_STREAM_FRAMES = 1_000_000


def looped(frames: Sequence[Frame], rate_hz: float) -> Iterator[Frame]:
    """Deliver ``frames`` again and again, as a camera of ``rate_hz`` would.

    Frames are numbered by the clock: one whose time has passed before it was asked for is lost, and its number skipped.
    """
    start, number = time.monotonic(), -1
    while True:
        number = max(number + 1, int((time.monotonic() - start) * rate_hz))
        time.sleep(max(start + number / rate_hz - time.monotonic(), 0.0))
        yield replace(frames[number % len(frames)], frame_id=number)


def paced(frames: Iterable[Frame], rate_hz: float) -> Iterator[Frame]:
    """Deliver ``frames`` at most ``rate_hz`` times a second; none is lost."""
    due = time.monotonic()
    for frame in frames:
        time.sleep(max(due - time.monotonic(), 0.0))
        due = max(due, time.monotonic()) + 1.0 / rate_hz
        yield frame


def streamed(camera: Camera) -> Iterator[Frame]:
    """Deliver the frames of a camera without end."""
    return itertools.chain.from_iterable(camera.frames(_STREAM_FRAMES) for _ in itertools.count())
