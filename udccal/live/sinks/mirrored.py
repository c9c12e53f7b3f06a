"""A sink that mirrors pictures, for people before an AR mirror."""

from __future__ import annotations

from dataclasses import replace
from typing import final

import numpy as np

from udccal.live.sinks.protocol import RestoredFrame, Sink


@final
class MirroredSink:
    """Implements ``udccal.live.sinks.protocol.Sink``: another sink gets every picture with left and right exchanged.

    A restored picture is what the camera sees of the people; they expect their mirror image. The camera, behind the
    panel, then sees the restored picture itself on it.
    """

    def __init__(self, sink: Sink) -> None:
        self._sink = sink

    def open(self, shape: tuple[int, int]) -> None:
        """Open the sink behind this one."""
        self._sink.open(shape)

    def write(self, frame: RestoredFrame) -> None:
        """Hand on the mirror image."""
        self._sink.write(replace(frame, picture=np.ascontiguousarray(frame.picture[:, ::-1])))

    def close(self) -> None:
        """Close the sink behind this one."""
        self._sink.close()
