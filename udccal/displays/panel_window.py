"""The full-screen window that shows pictures pixel for pixel. Runs in the process of the window only."""

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

# After a picture was handed over: one refresh until a compositor takes it, one more that its graphics driver may hold
# back, and one until it has been scanned out to the last row.
REFRESHES = 3
_UNKNOWN_HZ = 24.0  # of a monitor that does not tell: the slowest in use
_OPENING_S = 5.0
_SETTLING_S = 10.0  # at most, beyond what was asked for
_TICK_MS = 10


@final
class PanelWindow:
    """One window over one whole monitor, above all others, without a pointer.

    All methods must be called from the thread that made it, the process's main thread; ``handle`` must be given every
    event, so that the window answers the desktop and notices what happens to it.
    """

    def __init__(self, monitor: Monitor, alone: bool) -> None:
        """Open the window, and return once it is on screen.

        Args:
            monitor: where.
            alone: it is the only monitor, so that a window which takes the keyboard lies on top of this one. With
                several, a person may work on another one meanwhile.

        Raises:
            DisplayError: when it does not appear at the monitor's own resolution.
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
            allow_high_dpi=True,  # so that a desktop's scaling shows as a surface of another size, and is refused
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
        """Note what an event means for the picture on screen."""
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
        """Show a picture of the monitor's size, or black (None); return once it is seen on the panel.

        Presents in step with the monitor's refresh, then waits ``REFRESHES`` refreshes and ``settle_s``.

        Raises:
            DisplayError: as ``check`` for what was shown before, and when the window does not stay on screen.
        """
        self.check()
        self._settled = False
        if picture is None:
            self._picture.fill(0)
        else:
            pygame.surfarray.blit_array(self._picture, picture.swapaxes(0, 1))
        if self._alone and not self._window.focused:
            self._window.focus()
            with contextlib.suppress(pygame.error):  # not possible while it is hidden, which is told below
                self._window.focus(input_only=True)  # where no window manager heeds the first
        self._present()
        self._settle(REFRESHES / (self._monitor.refresh_hz or _UNKNOWN_HZ) + settle_s)
        self._refuse_trouble()
        self._settled = True

    def check(self) -> None:
        """Return when the window has been on screen, uncovered as far as can be known, since ``show`` returned.

        Raises:
            DisplayError: when it has not; said once, so that showing again may mend it, except for a closed window.
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
        pygame.mouse.set_visible(False)  # before the window is on screen, SDL does not heed it
        self._window.flip()
        self._presented = time.monotonic()

    def _uncovered(self) -> None:
        """The desktop asks for pixels to be drawn anew. X does so only for those that another window covered."""
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
        """Handle events until the picture was drawn last that many seconds ago."""
        latest = self._presented + seconds + _SETTLING_S
        while time.monotonic() < self._presented + seconds and not self._closed:
            if time.monotonic() > latest:
                raise DisplayError(
                    f"Expected the picture to stay on screen, found it covered again and again for {_SETTLING_S:g} s. "
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
        """What is wrong with the window now; empty when nothing is."""
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
