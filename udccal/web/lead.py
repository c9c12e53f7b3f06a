"""Which window leads: the first that answers. Others only watch."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, final

# Longer than a reload takes, or a phone needs to wake up.
LAPSE_S: Final = 20.0


@final
class Lead:
    """Holds the window that leads, until it was not heard of for ``LAPSE_S``: a phone with an empty battery, say."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._window: str | None = None
        self._heard_s = 0.0

    def heard(self, window: str) -> None:
        """Note that a window asked for news."""
        if window == self._window:
            self._heard_s = self._now_s()

    def allows(self, window: str) -> bool:
        """Whether a window may answer: it leads, or none does."""
        return self._window in (None, window) or self._now_s() - self._heard_s > LAPSE_S

    def take(self, window: str) -> None:
        """Let a window lead that ``allows`` has let answer."""
        self._window, self._heard_s = window, self._now_s()
