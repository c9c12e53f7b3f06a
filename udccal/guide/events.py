"""What a guided capture says, what it shows, and what a person may answer."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal, Protocol, final, runtime_checkable

from udccal.cameras.protocol import Frame


class Answer(enum.StrEnum):
    """What a person may answer; ``wrong`` is offered at a simulated rig alone: the hand there makes a mistake."""

    go = "go"
    again = "again"
    skip = "skip"
    back = "back"
    quit = "quit"
    wrong = "wrong"


class Quit(KeyboardInterrupt):
    """The answer ``quit`` where nothing but an exception can carry it; outside of a guided capture it is a Ctrl-C."""


@final
@dataclass(frozen=True)
class Reading:
    """One number read from the newest frame.

    Attributes:
        value: infinite where it is not known yet, as a movement is before a second look; ``null`` in JSON.
        low, high: bounds in which it is right; None for no bound.
        ok: whether it lies within them; a field, so that programs which read events see it.
    """

    name: str
    value: float
    low: float | None
    high: float | None
    unit: str
    ok: bool = field(init=False)

    def __post_init__(self) -> None:
        ok = (self.low is None or self.value >= self.low) and (self.high is None or self.value <= self.high)
        object.__setattr__(self, "ok", ok)


def in_order(readings: Iterable[Reading], sentence: str) -> bool:
    """Whether a look found nothing wrong: no sentence says what is, and all readings are within their bounds."""
    return not sentence and all(reading.ok for reading in readings)


@final
@dataclass(frozen=True)
class Outline:
    """Where something is to be seen, or is seen, in sensor px (column, row): one point is a cross, more a polygon."""

    points_px: tuple[tuple[float, float], ...]
    meaning: Literal["wanted", "seen"]


@final
@dataclass(frozen=True)
class StepEvent:
    """A step begins.

    Attributes:
        id: of the step.
        title: a few words.
        why: one sentence: what the step is good for.
        instruction: what to do, as sentences.
        drawing: the rig from the side, to scale, as SVG.
        number, of: place of the step, from 1, and how many there are.
        minutes_left: for this and all later steps.
    """

    id: str
    title: str
    why: str
    instruction: str
    drawing: str
    number: int
    of: int
    minutes_left: float
    event: Literal["step"] = "step"


@final
@dataclass(frozen=True)
class ReadingsEvent:
    """What the newest frame shows, and in words what is wrong with it; an empty sentence when nothing is."""

    step_id: str
    readings: tuple[Reading, ...]
    sentence: str
    event: Literal["readings"] = "readings"


@final
@dataclass(frozen=True)
class ProgressEvent:
    """Frames captured of a step."""

    step_id: str
    frames: int
    of: int
    event: Literal["progress"] = "progress"


@final
@dataclass(frozen=True)
class VerdictEvent:
    """How a step ended, in one sentence, and the answers that are offered now."""

    step_id: str
    ok: bool
    sentence: str
    offered: tuple[Answer, ...]
    event: Literal["verdict"] = "verdict"


@final
@dataclass(frozen=True)
class RequestEvent:
    """What a person is asked to do in the middle of a step, such as to show a picture, and the answers offered."""

    sentence: str
    offered: tuple[Answer, ...]
    event: Literal["request"] = "request"


@final
@dataclass(frozen=True)
class DoneEvent:
    """The capture has ended; it is complete when every step was captured, and stopped when the person has quit."""

    complete: bool
    stopped: bool
    sentence: str
    event: Literal["done"] = "done"


Event = StepEvent | ReadingsEvent | ProgressEvent | VerdictEvent | RequestEvent | DoneEvent


@runtime_checkable
class Person(Protocol):
    """Who is led: somebody at a terminal, before a page, or simulated.

    All methods are called from the thread that captures. None may block it but ``answer``.
    """

    def tell(self, event: Event) -> None:
        """Take an event, in the order in which they happen."""
        ...

    def look(self, frame: Frame, outlines: tuple[Outline, ...]) -> None:
        """Take the newest frame, with what is wanted and seen where. Frames that nobody has time for may be dropped."""
        ...

    def answer(self, offered: tuple[Answer, ...], wait_s: float) -> Answer | None:
        """Wait up to ``wait_s`` for one of the answers that are offered; return None when none came."""
        ...
