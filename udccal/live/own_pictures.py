"""What an AR mirror's panel shows: the run's own pictures, each until the next one."""

from __future__ import annotations

import threading
from collections import deque
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import UInt8

from udccal.rig import Panel

PanelPicture = UInt8[np.ndarray, "panel_rows panel_columns 3"]
# A frame waits no longer for its restoration, at a frame a second or more: a newer one takes its place.
_WAITS_NS: Final = 10**9


@final
class OwnPictures:
    """The pictures that the sink took, scaled to fill the panel, as the camera sees them there.

    People in front see them with left and right exchanged (``udccal.live.sinks.mirrored``).

    Args:
        panel: its size.
        delay_s: from a picture's writing to the middle of its time on the panel.
    """

    def __init__(self, panel: Panel, delay_s: float) -> None:
        self._size, self._delay_ns = (panel.columns, panel.rows), round(delay_s * 1e9)
        self._written: deque[tuple[int, UInt8[np.ndarray, "rows columns 3"]]] = deque()
        self._latest: tuple[int, PanelPicture] | None = None
        self._lock = threading.Lock()

    def wrote(self, picture: UInt8[np.ndarray, "rows columns 3"], at_ns: int) -> None:
        """Take a picture that the sink has taken at a time of the monotonic clock, which is now."""
        with self._lock:
            self._written.append((at_ns, picture))
            self._forget(at_ns - _WAITS_NS)

    def at(self, captured_ns: int) -> PanelPicture | None:
        """Return what the panel showed while a frame was exposed that arrived then; None before the first picture.

        Frames come in order: pictures before the one that is returned are forgotten.
        """
        with self._lock:
            self._forget(captured_ns)
            at_ns, picture = self._written[0] if self._written else (captured_ns, None)
        if picture is None or at_ns + self._delay_ns > captured_ns:
            return None
        if self._latest is None or self._latest[0] != at_ns:
            self._latest = at_ns, cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA)
        return self._latest[1]

    def _forget(self, captured_ns: int) -> None:
        """Forget pictures that the panel no longer showed at a time: their successors were there."""
        while len(self._written) > 1 and self._written[1][0] + self._delay_ns <= captured_ns:
            self._written.popleft()
