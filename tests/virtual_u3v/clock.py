"""The camera's time: simulated, so that waiting costs nothing, or the wall's."""

from __future__ import annotations

import time
from typing import Protocol, final


class Clock(Protocol):
    """A time in ns since the camera was made, and a way to wait."""

    def now_ns(self) -> int: ...

    def wait_ns(self, duration_ns: int) -> None: ...


@final
class SimulatedClock:
    """Waiting moves the clock on and returns at once."""

    def __init__(self) -> None:
        self._now_ns = 0

    def now_ns(self) -> int:
        return self._now_ns

    def wait_ns(self, duration_ns: int) -> None:
        self._now_ns += max(0, duration_ns)


@final
class WallClock:
    """Waiting takes as long as it says."""

    def __init__(self) -> None:
        self._start_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        return time.monotonic_ns() - self._start_ns

    def wait_ns(self, duration_ns: int) -> None:
        time.sleep(max(0, duration_ns) * 1e-9)
