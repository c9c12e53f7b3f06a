"""What a person is led through: steps that each cover one set-up, and how each looks at a frame and captures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, final, runtime_checkable

from udccal.arrangements import Stage
from udccal.cameras.protocol import Camera, Frame
from udccal.displays.protocol import Display
from udccal.guide.events import Outline, Reading, in_order
from udccal.sessions.schema import TermName
from udccal.sessions.writer import SessionWriter


@final
@dataclass(frozen=True)
class Look:
    """The newest frame, and what it shows.

    Attributes:
        frame: the frame.
        readings: numbers read from it.
        sentence: what is wrong and what to do; empty when all is in order.
        outlines: what is wanted and seen where.
    """

    frame: Frame
    readings: tuple[Reading, ...]
    sentence: str
    outlines: tuple[Outline, ...] = ()

    @property
    def in_order(self) -> bool:
        """Whether the step may be captured now."""
        return in_order(self.readings, self.sentence)


@runtime_checkable
class Visit(Protocol):
    """A guided step under way."""

    def look(self) -> Look:
        """Take a frame and say what it shows.

        Raises:
            CaptureError: when no frame can be had.
        """
        ...

    def capture(self) -> Iterator[int]:
        """Capture what stands before the camera.

        Yields:
            after each step that was captured, how many frames wait until the session gains them together.

        Raises:
            CaptureError: when the camera does not see what is needed.
            SessionError: from the writer.
        """
        ...


Begin = Callable[[Camera, Display, Stage, SessionWriter], Visit]


@final
@dataclass(frozen=True)
class GuidedStep:
    """What one set-up by a person covers.

    Attributes:
        id: unique among the guided steps of a rig.
        term: that it is captured for.
        title, why, instruction, drawing: as a ``StepEvent`` has them.
        step_ids: the session's steps that it captures.
        needs: ids of earlier steps whose exposure it takes up.
        frames: how many are kept in all.
        by_itself: whether a capture begins as soon as a look is in order. Otherwise it waits for the answer ``go``.
        begin: sets up what the rig can by itself, and returns the step under way.
    """

    id: str
    term: TermName
    title: str
    why: str
    instruction: str
    drawing: str
    step_ids: tuple[str, ...]
    needs: tuple[str, ...]
    frames: int
    by_itself: bool
    begin: Begin
