"""``window:TITLE``: a window on the desktop, where OpenCV has windows."""

from __future__ import annotations

from typing import final

import cv2

from udccal.errors import LiveError
from udccal.live.sinks.protocol import RestoredFrame


@final
class WindowSink:
    """Implements ``udccal.live.sinks.protocol.Sink``."""

    def __init__(self, target: str, rate_hz: float) -> None:
        self._title = target or "udccal"
        if not _has_windows():
            raise LiveError(
                "Expected an OpenCV that has windows, found the headless build that udccal installs. Use --sink "
                "shm:NAME and show its frames with examples/read_live.py, or --sink video:FILE.mp4."
            )

    def open(self, shape: tuple[int, int]) -> None:
        """Open the window."""
        try:
            cv2.namedWindow(self._title, cv2.WINDOW_NORMAL)
        except cv2.error as error:
            raise LiveError(f"Expected a desktop to open a window on, found: {error}. Use --sink shm:NAME.") from error

    def write(self, frame: RestoredFrame) -> None:
        """Show a frame."""
        cv2.imshow(self._title, cv2.cvtColor(frame.picture, cv2.COLOR_RGB2BGR))
        cv2.waitKey(1)

    def close(self) -> None:
        """Close the window."""
        cv2.destroyAllWindows()


def _has_windows() -> bool:
    """Return whether this build of OpenCV can open windows: its own description names the toolkit, or NONE."""
    lines = [line.split(":", 1)[1].strip() for line in cv2.getBuildInformation().splitlines() if "GUI:" in line]
    return any(line and line != "NONE" for line in lines)
