"""The newest frame, made a picture when a window asks for it."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, final

from udccal.cameras.protocol import Frame, Region
from udccal.guide.events import Outline
from udccal.web.picture import Picture

PERIOD_S: Final = 0.2
# Of one thread's time. OpenCV's own threads may double it.
_SHARE = 0.1


@final
@dataclass(frozen=True)
class View:
    """A frame as windows get it; ``number`` counts frames, ``region`` says which part of the sensor it shows."""

    number: int
    region: Region
    picture: Picture
    outlines: tuple[Outline, ...]


@final
@dataclass(frozen=True)
class _Seen:
    number: int
    frame: Frame
    outlines: tuple[Outline, ...]


@final
class LiveView:
    """Takes every frame at no cost; makes a picture of the newest only while somebody asks, at most five a second.

    Args:
        make: makes a picture of a frame.
        now_s, spent_s: the time, and how much of it this thread has computed.
    """

    def __init__(
        self,
        make: Callable[[Frame], Picture],
        now_s: Callable[[], float] = time.monotonic,
        spent_s: Callable[[], float] = time.thread_time,
    ) -> None:
        self._make, self._now_s, self._spent_s = make, now_s, spent_s
        self._numbers = itertools.count(1)
        self._newest: _Seen | None = None
        self._making = threading.Lock()
        self._made: View | None = None
        self._due_s = -math.inf

    def look(self, frame: Frame, outlines: tuple[Outline, ...]) -> None:
        """Take the newest frame; nothing is copied, and nothing waits."""
        self._newest = _Seen(next(self._numbers), frame, outlines)

    def newer(self, number: int) -> View | None:
        """Return the newest view if it is newer than ``number``, else None; make one first when it is time."""
        with self._making:
            seen = self._newest
            if seen is not None and (self._made is None or self._made.number < seen.number):
                self._make_when_due(seen)
            return self._made if self._made is not None and self._made.number > number else None

    def _make_when_due(self, seen: _Seen) -> None:
        now_s = self._now_s()
        if now_s < self._due_s:
            return
        before_s = self._spent_s()
        picture = self._make(seen.frame)
        self._due_s = now_s + max(PERIOD_S, (self._spent_s() - before_s) / _SHARE)
        self._made = View(seen.number, seen.frame.settings.region, picture, seen.outlines)
