"""``v4l2:/dev/videoN``: a virtual camera of Linux that other programs open, through pyvirtualcam and v4l2loopback."""

from __future__ import annotations

import importlib
import os
import re
from types import ModuleType
from typing import Any, final

from udccal.errors import LiveError
from udccal.live.sinks.protocol import RestoredFrame


@final
class VirtualCameraSink:
    """Implements ``udccal.live.sinks.protocol.Sink``; size and format are set before the first reader can open it."""

    def __init__(self, target: str, rate_hz: float) -> None:
        if not re.fullmatch(r"/dev/video[0-9]+", target):
            raise LiveError(f"Expected v4l2:/dev/videoN, found '{target}'. Name the device of v4l2loopback.")
        self._target, self._rate_hz = target, rate_hz
        self._library = _library()
        if not os.access(target, os.W_OK):
            raise LiveError(
                f"Expected a virtual camera at {target} that may be written to, found none. Load v4l2loopback "
                "(modprobe v4l2loopback), or correct the device's permissions."
            )
        self._camera: Any = None

    def open(self, shape: tuple[int, int]) -> None:
        """Set the device's format."""
        rows, columns = shape
        try:
            self._camera = self._library.Camera(
                columns, rows, self._rate_hz, device=self._target, fmt=self._library.PixelFormat.RGB
            )
        except RuntimeError as error:
            raise LiveError(
                f"Expected a virtual camera at {self._target}, found: {error}. Load v4l2loopback (modprobe "
                "v4l2loopback), and close what else writes to it."
            ) from error

    def write(self, frame: RestoredFrame) -> None:
        """Send a frame."""
        self._camera.send(frame.picture)

    def close(self) -> None:
        """Leave the device."""
        if self._camera is not None:
            self._camera.close()


def _library() -> ModuleType:
    try:
        return importlib.import_module("pyvirtualcam")
    except ImportError as error:
        raise LiveError(
            "Expected the package pyvirtualcam, which writes to virtual cameras, found none. Run "
            "pip install 'udccal[v4l2]', or use --sink shm:NAME."
        ) from error
