"""What the page shows of a capture, from the events told so far."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

from udccal.guide.events import (
    Answer,
    DoneEvent,
    Event,
    ProgressEvent,
    ReadingsEvent,
    RequestEvent,
    StepEvent,
    VerdictEvent,
)


@final
@dataclass(frozen=True)
class Question:
    """Answers that are offered; another number is another question, so that a late answer meets none."""

    number: int
    offered: tuple[Answer, ...]


@final
@dataclass(frozen=True)
class Shown:
    """The newest event of each kind that still holds, and the open question; a new step clears the others."""

    step: StepEvent | None = None
    readings: ReadingsEvent | None = None
    progress: ProgressEvent | None = None
    verdict: VerdictEvent | None = None
    request: RequestEvent | None = None
    done: DoneEvent | None = None
    question: Question | None = None

    def after(self, event: Event) -> Shown:
        """The same after one more event. All but readings and progress close the question."""
        match event:
            case StepEvent():
                return Shown(step=event)
            case ReadingsEvent():
                return replace(self, readings=event)
            case ProgressEvent():
                return replace(self, progress=event)
            case VerdictEvent():
                return replace(self, verdict=event, readings=None, question=None)
            case RequestEvent():
                return replace(self, request=event, readings=None, question=None)
            case DoneEvent():
                return Shown(step=self.step, done=event)

    def answered(self) -> Shown:
        """The same after an answer: the question and what led to it are past."""
        return replace(self, verdict=None, request=None, progress=None, question=None)
