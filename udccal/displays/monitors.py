"""The monitors of this computer, as SDL sees them. This module runs only in the window's process."""

from __future__ import annotations

from collections.abc import Sequence

import pygame

from udccal.displays.protocol import PanelSize
from udccal.displays.window_messages import Monitor
from udccal.errors import DisplayError

# SDL_WINDOWPOS_CENTERED_DISPLAY of SDL_video.h: added to a monitor's number, it stands for the middle of that monitor.
CENTRED_ON = 0x2FFF0000
_LEAST_BITS = 24


def seen_monitors() -> tuple[Monitor, ...]:
    """Return every monitor; SDL's video must have been initialised."""
    sizes = pygame.display.get_desktop_sizes()
    rates = pygame.display.get_desktop_refresh_rates()
    return tuple(
        Monitor(index, *_place(index, *size), *size, rate)
        for index, (size, rate) in enumerate(zip(sizes, rates, strict=True))
    )


def _place(index: int, columns: int, rows: int) -> tuple[int, int]:
    """Return a monitor's top left corner: the position of a hidden window of its size that is centred on it."""
    hidden = pygame.Window("", (columns, rows), (CENTRED_ON | index, CENTRED_ON | index), hidden=True)
    try:
        x, y = hidden.position
        return int(x), int(y)
    finally:
        hidden.destroy()


def choose_monitor(monitors: Sequence[Monitor], index: int, size: PanelSize) -> Monitor:
    """Return a monitor by its number, after checking that it can show the panel's pictures.

    Raises:
        DisplayError: when there is none, or it does not run at the panel's size, in full colour, at a position of its
            own on the desktop.
    """
    if not 0 <= index < len(monitors):
        raise DisplayError(f"Expected a monitor with number {index}, found {describe(monitors)}. Choose one of these.")
    chosen = monitors[index]
    if (chosen.columns, chosen.rows) != (size.columns, size.rows):
        raise DisplayError(
            f"Expected monitor {index} to run at the panel's {size.columns} x {size.rows} pixels, found "
            f"{describe(monitors)}. Set that resolution, without scaling, or choose another monitor."
        )
    if any((other.x, other.y) == (chosen.x, chosen.y) for other in monitors[:index]):
        raise DisplayError(
            f"Expected monitor {index} to have a position of its own on the desktop, found {describe(monitors)}. "
            "Set the monitors side by side, not mirrored."
        )
    bits = pygame.display.Info().bitsize
    if bits < _LEAST_BITS:
        raise DisplayError(
            f"Expected a desktop of {_LEAST_BITS} bits per pixel, found {bits}. Set the desktop to full colour."
        )
    return chosen


def describe(monitors: Sequence[Monitor]) -> str:
    """Describe all monitors in one phrase."""
    return "; ".join(_phrase(monitor) for monitor in monitors) or "no monitor"


def _phrase(monitor: Monitor) -> str:
    rate = f", {monitor.refresh_hz} Hz" if monitor.refresh_hz else ""
    return f"monitor {monitor.index}: {monitor.columns} x {monitor.rows} at ({monitor.x}, {monitor.y}){rate}"
