"""``window:TITLE``: a window on the desktop, by SDL. ``window:N`` fills monitor N, such as a mirror's panel."""

from __future__ import annotations

import importlib
import os
from types import ModuleType
from typing import Any, Final, final

import cv2
import numpy as np

from udccal.errors import LiveError
from udccal.live.sinks.protocol import RestoredFrame

# SDL_WINDOWPOS_CENTERED_DISPLAY of SDL_video.h: added to a monitor's number, it stands for the middle of that monitor.
_CENTRED_ON: Final = 0x2FFF0000
_INVISIBLE: Final = ("dummy", "evdev", "offscreen")  # SDL's drivers without a screen


@final
class WindowSink:
    """Implements ``udccal.live.sinks.protocol.Sink``: frames as large as the window shows them whole.

    A person ends the run by closing the window, or with Escape.
    """

    def __init__(self, target: str, rate_hz: float) -> None:
        self._monitor = int(target) if target.isdecimal() and target.isascii() and len(target) < 4 else None
        self._title = "udccal" if self._monitor is not None else target or "udccal"
        self._pygame = _library()
        self._window: Any = None
        self._reach_desktop()
        self._pygame.display.quit()  # windows belong to the thread that opens them

    def open(self, shape: tuple[int, int]) -> None:
        """Open the window."""
        game, (rows, columns) = self._pygame, shape
        self._reach_desktop()
        if self._monitor is None:
            self._window = game.Window(self._title, (columns, rows), resizable=True)
            return
        sizes = game.display.get_desktop_sizes()
        if self._monitor >= len(sizes):
            raise LiveError(
                f"Expected a monitor with number {self._monitor}, found monitors 0 to {len(sizes) - 1}. Choose one."
            )
        place = (_CENTRED_ON | self._monitor,) * 2
        self._window = game.Window(self._title, sizes[self._monitor], place, fullscreen_desktop=True, borderless=True)
        game.mouse.set_visible(False)

    def _reach_desktop(self) -> None:
        game = self._pygame
        try:
            game.display.init()
            driver = game.display.get_driver()
        except game.error as error:
            driver = str(error)
        if not game.display.get_init() or driver in _INVISIBLE:
            raise LiveError(
                f"Expected a desktop to open a window on, found none ({driver}). Run this in a desktop session, or use "
                "--sink shm:NAME."
            )

    def write(self, frame: RestoredFrame) -> None:
        """Show a frame."""
        game = self._pygame
        for event in game.event.get():
            escape = event.type == game.KEYDOWN and event.key == game.K_ESCAPE
            if escape or event.type in (game.QUIT, game.WINDOWCLOSE):
                raise LiveError("Expected the window to stay open, found that it was closed. Start again to go on.")
        surface = self._window.get_surface()
        (width, height), (rows, columns) = surface.get_size(), frame.picture.shape[:2]
        scale = min(width / columns, height / rows)
        size = max(round(columns * scale), 1), max(round(rows * scale), 1)
        shown = frame.picture if size == (columns, rows) else cv2.resize(frame.picture, size)
        surface.fill(0)
        picture = game.image.frombuffer(np.ascontiguousarray(shown), size, "RGB")
        surface.blit(picture, ((width - size[0]) // 2, (height - size[1]) // 2))
        self._window.flip()

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.destroy()
        self._pygame.display.quit()


def _library() -> ModuleType:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # its greeting would stand before our JSON
    try:
        return importlib.import_module("pygame")
    except ImportError as error:
        raise LiveError(
            "Expected the package pygame-ce, which opens windows, found none. Run pip install 'udccal[window]', or use "
            "--sink shm:NAME and a viewer of yours."
        ) from error
