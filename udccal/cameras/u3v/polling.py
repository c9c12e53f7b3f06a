"""Polls a camera, with bounds on time and number."""

from __future__ import annotations

import time
from collections.abc import Callable


def comes_true(asked: Callable[[], bool], wait_s: float, interval_s: float) -> bool:
    """Ask at least once, until the answer is yes or the time is over.

    Polling is bounded in time, since each answer may take long, and in number, since a camera's time may be simulated.

    Args:
        interval_s: pause between two questions.
    """
    latest = time.monotonic() + wait_s
    for _ in range(max(1, round(wait_s / interval_s))):
        if asked():
            return True
        if time.monotonic() >= latest:
            return False
        time.sleep(interval_s)
    return False
