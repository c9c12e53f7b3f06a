"""Delivers frames to the caller."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import final

from udccal.cameras.protocol import Frame
from udccal.errors import CameraError


@final
class Delivery:
    """An iterator over frames that raises an error when it is ended from elsewhere."""

    def __init__(self, frames: Iterator[tuple[Frame, int]], deliver: Callable[[Frame, int], None]) -> None:
        self._frames = frames
        self._deliver = deliver
        self._ended = False

    def __iter__(self) -> Delivery:
        return self

    def __next__(self) -> Frame:
        if self._ended:
            raise CameraError(
                "Expected frames with the requested settings, found that the camera was closed, "
                "configured or asked again in between. Ask for frames again."
            )
        frame, lost = next(self._frames)
        self._deliver(frame, lost)
        return frame

    def end(self) -> None:
        """Stop the camera, if it still runs."""
        self._ended = True
        close = getattr(self._frames, "close", None)
        if close is not None:
            close()
