"""What the panel's window and the program that asks for pictures say to each other; needs no SDL."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

# Requests, one per line: show the picture in the shared file, show black, say whether all is still well.
Request = Literal["show", "black", "check"]


@final
@dataclass(frozen=True)
class Monitor:
    """One monitor.

    Attributes:
        index: SDL's number of it, from 0.
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
    """What a window's process is started for.

    Attributes:
        monitor: its number; None only lists the monitors.
        settle_s: wait after the picture was handed to the monitor.
        picture: file of rows x columns x 3 bytes that both processes share.
    """

    monitor: int | None = None
    columns: int = 0
    rows: int = 0
    settle_s: float = 0.0
    picture: str = ""


@final
@dataclass(frozen=True)
class Reply:
    """The answer to one request; ``problem`` is empty when it was done."""

    problem: str = ""
    monitors: tuple[Monitor, ...] = ()
