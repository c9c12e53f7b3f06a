"""Messages between the panel's window and the program that asks for pictures; this module needs no SDL."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

# Requests, one per line: show the picture in the shared file, show black, check that the window stayed on screen.
Request = Literal["show", "black", "check"]


@final
@dataclass(frozen=True)
class Monitor:
    """One monitor.

    Attributes:
        index: SDL's number of the monitor, from 0.
        x: desktop column of its first pixel.
        y: desktop row of its first pixel.
        refresh_hz: 0 when not known.
    """

    index: int
    x: int
    y: int
    columns: int
    rows: int
    refresh_hz: int


@final
@dataclass(frozen=True)
class Job:
    """Task of a window's process.

    Attributes:
        monitor: number of the monitor; None only lists the monitors.
        columns: columns of the panel.
        rows: rows of the panel.
        settle_s: wait after the monitor received the picture.
        picture: path of the file of rows x columns x 3 bytes that both processes use.
    """

    monitor: int | None = None
    columns: int = 0
    rows: int = 0
    settle_s: float = 0.0
    picture: str = ""


@final
@dataclass(frozen=True)
class Reply:
    """The answer to one request; ``problem`` is empty when the request succeeded."""

    problem: str = ""
    monitors: tuple[Monitor, ...] = ()
