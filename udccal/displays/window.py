"""A display on a monitor of this computer: a full-screen window, one picture pixel on one panel pixel."""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import TracebackType
from typing import final

import numpy as np
from jaxtyping import UInt8

from udccal.displays.checked import check_picture
from udccal.displays.protocol import PanelSize
from udccal.displays.window_link import START_S, WindowLink
from udccal.displays.window_messages import Job, Monitor
from udccal.errors import DisplayError

# Televisions with picture processing delay a picture by up to about 0.15 s; then their brightness has to settle.
SETTLE_S = 0.5
_ANSWER_S = 20.0


def list_monitors() -> tuple[Monitor, ...]:
    """Return the monitors that a window can be shown on.

    Raises:
        DisplayError: when the optional package is missing, or no desktop can be reached.
    """
    link = WindowLink(Job())
    try:
        return link.reply(START_S).monitors
    finally:
        link.close()


@final
class WindowDisplay:
    """Implements ``udccal.displays.protocol.Display`` with an SDL window in a process of its own.

    The window responds to the desktop all the time. When it was closed, minimised, moved or covered, as far as the
    desktop reports it, the next call of ``show``, ``off`` or ``check`` raises the error.
    """

    def __init__(self, monitor: int, size: PanelSize, settle_s: float = SETTLE_S) -> None:
        """Args:
        monitor: number of the monitor in ``list_monitors``; it must run at ``size``.
        size: pixels of the panel.
        settle_s: wait after the monitor received a picture, for the panel's own delay.
        """
        if not 0 <= settle_s <= 60:
            raise DisplayError(f"Expected to wait from 0 to 60 s for the panel to settle, found {settle_s:g} s.")
        self._monitor = monitor
        self._size = size
        self._settle_s = settle_s
        self._link: WindowLink | None = None
        self._folder: tempfile.TemporaryDirectory | None = None
        self._shared: np.memmap | None = None

    @property
    def size(self) -> PanelSize:
        """Pixels of the panel."""
        return self._size

    def __enter__(self) -> WindowDisplay:
        """Open the window, black.

        Raises:
            DisplayError: when the optional package is missing, no desktop can be reached, or the monitor is missing or
                does not run at the panel's size.
        """
        rows, columns = self._size.rows, self._size.columns
        self._folder = tempfile.TemporaryDirectory(prefix="udccal-panel-")
        try:
            file = Path(self._folder.name) / "picture.rgb"
            self._shared = np.memmap(file, np.uint8, "w+", shape=(rows, columns, 3))
            self._link = WindowLink(Job(self._monitor, columns, rows, self._settle_s, str(file)))
            self._link.reply(START_S)
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Take the window off the screen; what the desktop shows there comes back."""
        self._close()

    def show(self, picture: UInt8[np.ndarray, "rows columns 3"]) -> None:
        """Show an 8-bit RGB picture at the panel's own resolution, and return once it is on screen.

        Raises:
            DisplayError: when the picture is not 8-bit RGB of the panel's size, the window has not stayed on screen
                since the last call, or the picture cannot be shown now.
        """
        check_picture(picture, self._size)
        link = self._opened_anew()
        assert self._shared is not None
        self._shared[:] = picture
        link.ask("show", self._settle_s + _ANSWER_S)

    def off(self) -> None:
        """Show black; errors as ``show``."""
        self._opened_anew().ask("black", self._settle_s + _ANSWER_S)

    def check(self) -> None:
        """Check that the window has stayed on screen since the last call.

        Raises:
            DisplayError: when it has not.
        """
        self._opened().ask("check", _ANSWER_S)

    def _opened(self) -> WindowLink:
        if self._link is None:
            raise DisplayError("Expected an open window, found it closed. Use it in a 'with' statement.")
        return self._link

    def _opened_anew(self) -> WindowLink:
        """Return the link; open a new window where the process ended, which an earlier call has reported."""
        if not self._opened().alive:
            self._close()
            self.__enter__()
        return self._opened()

    def _close(self) -> None:
        if self._link is not None:
            self._link.close()
        self._shared = None
        if self._folder is not None:
            self._folder.cleanup()
        self._link = self._folder = None
