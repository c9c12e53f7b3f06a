"""The full-screen window that shows pictures pixel for pixel. This module runs only in the window's process."""

from __future__ import annotations

import contextlib
import time
from typing import final

import numpy as np
import pygame
from jaxtyping import UInt8

from udccal.displays.monitors import CENTRED_ON
from udccal.displays.window_messages import Monitor
from udccal.errors import DisplayError

# Refreshes after a picture is handed over: one until a compositor takes it, one that its graphics driver may hold it
# back, and one until it has been scanned out to the last row.
REFRESHES = 3
_UNKNOWN_HZ = 24.0  # assumed for a monitor that does not report its rate: the slowest in use
_OPENING_S = 5.0
_SETTLING_S = 10.0  # longest wait beyond the requested time
_TICK_MS = 10


@final
class PanelWindow:
    """One window over one whole monitor, above all others, without a pointer.

    All methods must be called from the thread that made it, the process's main thread. ``handle`` must be given every
    event, so that the window responds to the desktop and notices when it is covered, moved or closed.
    """

    def __init__(self, monitor: Monitor, alone: bool) -> None:
        """Open the window, and return once it is on screen.

        Args:
            monitor: the monitor to fill.
            alone: whether it is the only monitor. Then a window that takes the keyboard covers this one; with several
                monitors, a person may work on another one.

        Raises:
            DisplayError: when the window does not appear at the monitor's own resolution.
        """
        self._monitor = monitor
        self._alone = alone
        self._exposed = False
        self._visible = False
        self._closed = False
        self._settled = False
        self._lost = ""
        self._presented = 0.0
        place = (CENTRED_ON | monitor.index, CENTRED_ON | monitor.index)
        size = (monitor.columns, monitor.rows)
        self._window = pygame.Window(
            "udccal panel",
            size,
            position=place,
            fullscreen_desktop=True,
            borderless=True,
            always_on_top=True,
            allow_high_dpi=True,  # a scaled desktop then gives a surface of another size, which is refused
        )
        self._picture = pygame.Surface(size, depth=24)
        pygame.display.set_allow_screensaver(False)
        try:
            self._open()
        except DisplayError:
            self.close()
            raise

    def close(self) -> None:
        """Take the window off the screen."""
        self._closed = True
        self._window.destroy()

    def handle(self, event: pygame.event.Event) -> None:
        """Record what an event means for the picture on screen."""
        if event.type in (pygame.QUIT, pygame.WINDOWCLOSE):
            self._closed = True
            self._lose("it was closed")
            self._window.hide()
        elif event.type in (pygame.WINDOWMINIMIZED, pygame.WINDOWHIDDEN):
            self._visible = False
            self._lose("it was minimised or hidden")
        elif event.type in (pygame.WINDOWSHOWN, pygame.WINDOWRESTORED):
            self._visible = True
        elif event.type in (pygame.WINDOWMOVED, pygame.WINDOWSIZECHANGED) and not self._in_place():
            self._lose("it was moved or resized")
        elif event.type == pygame.WINDOWFOCUSLOST and self._alone:
            self._lose("another window took the keyboard, and covers it on the only monitor")
        elif event.type == pygame.WINDOWEXPOSED:
            self._uncovered()

    def show(self, picture: UInt8[np.ndarray, "rows columns 3"] | None, settle_s: float) -> None:
        """Show a picture of the monitor's size, or black (None); return once it is visible on the panel.

        Presents in step with the monitor's refresh, then waits ``REFRESHES`` refreshes and ``settle_s``.

        Raises:
            DisplayError: as ``check`` for the picture shown before, and when the window does not stay on screen.
        """
        self.check()
        self._settled = False
        if picture is None:
            self._picture.fill(0)
        else:
            pygame.surfarray.blit_array(self._picture, picture.swapaxes(0, 1))
        if self._alone and not self._window.focused:
            self._window.focus()
            with contextlib.suppress(pygame.error):  # fails while the window is hidden, which is reported below
                self._window.focus(input_only=True)  # for desktops without a window manager
        self._present()
        self._settle(REFRESHES / (self._monitor.refresh_hz or _UNKNOWN_HZ) + settle_s)
        self._refuse_trouble()
        self._settled = True

    def check(self) -> None:
        """Check that the window has stayed on screen since ``show`` returned, uncovered as far as the desktop reports.

        Raises:
            DisplayError: when it has not; raised once, so that showing again can succeed, unless the window was closed.
        """
        for event in pygame.event.get():
            self.handle(event)
        lost = self._lost
        if lost:
            self._lost = "it was closed" if self._closed else ""
            raise DisplayError(
                f"Expected the panel's window to stay on screen, found that {lost}. Leave it alone, and run the same "
                "command again."
            )

    def _present(self) -> None:
        self._window.get_surface().blit(self._picture, (0, 0))
        pygame.mouse.set_visible(False)  # SDL ignores this before the window is on screen
        self._window.flip()
        self._presented = time.monotonic()

    def _uncovered(self) -> None:
        """Draw again when the desktop asks for it. X asks only for pixels that another window covered."""
        self._exposed = True
        if pygame.display.get_driver() == "x11":
            self._lose("another window covered it for a while")
        self._present()

    def _lose(self, how: str) -> None:
        if self._settled or self._closed:
            self._lost = self._lost or how

    def _open(self) -> None:
        latest = time.monotonic() + _OPENING_S
        while self._trouble() and not self._closed and time.monotonic() < latest:
            self._handle_next()
        self._refuse_trouble()

    def _settle(self, seconds: float) -> None:
        """Handle events until this many seconds have passed since the picture was last drawn."""
        latest = self._presented + seconds + _SETTLING_S
        while time.monotonic() < self._presented + seconds and not self._closed:
            if time.monotonic() > latest:
                raise DisplayError(
                    f"Expected the picture to stay on screen, found it covered repeatedly for {_SETTLING_S:g} s. "
                    "Keep other windows and pop-ups off the panel's monitor."
                )
            self._handle_next()

    def _handle_next(self) -> None:
        event = pygame.event.wait(_TICK_MS)
        if event.type != pygame.NOEVENT:
            self.handle(event)

    def _refuse_trouble(self) -> None:
        trouble = self._trouble()
        if trouble:
            raise DisplayError(
                f"Expected the panel's window to fill monitor {self._monitor.index}, found that {trouble}. Set the "
                "desktop's scaling to 100 %, and keep other windows off that monitor."
            )

    def _trouble(self) -> str:
        """Return what is wrong with the window now; empty when nothing is wrong."""
        if self._closed:
            return "it was closed"
        if not (self._exposed and self._visible):
            return "it is not on screen"
        if not self._in_place():
            (x, y), (columns, rows) = self._window.position, self._window.get_surface().get_size()
            return f"it has {columns} x {rows} pixels at ({x}, {y})"
        if self._alone and not self._window.focused:
            return "another window has the keyboard"
        return ""

    def _in_place(self) -> bool:
        size = (self._monitor.columns, self._monitor.rows)
        sizes = {tuple(self._window.size), self._window.get_surface().get_size()}
        return tuple(self._window.position) == (self._monitor.x, self._monitor.y) and sizes == {size}
