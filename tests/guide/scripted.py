"""A scripted person: goes on where all is in order, and does what a test says where something comes up."""

from __future__ import annotations

from collections.abc import Callable

from udccal.cameras.protocol import Frame
from udccal.guide.events import (
    Answer,
    DoneEvent,
    Event,
    Outline,
    ReadingsEvent,
    StepEvent,
    VerdictEvent,
    in_order,
)

MOST_LOOKS = 150

# Gets the newest event and what is offered; returns an answer, or None to do as a willing person does.
Reaction = Callable[[Event, tuple[Answer, ...]], Answer | None]


class Scripted:
    """Implements ``Person``.

    Attributes:
        events: everything told.
        prompts: how often a step or verdict waited for an answer and got one.
    """

    def __init__(self, react: Reaction = lambda event, offered: None) -> None:
        self.events: list[Event] = []
        self.prompts = 0
        self._react = react
        self._looks = 0

    def tell(self, event: Event) -> None:
        self._looks = self._looks + 1 if isinstance(event, ReadingsEvent) else 0
        assert self._looks < MOST_LOOKS, f"the same step is looked at for ever: {event}"
        self.events.append(event)

    def look(self, frame: Frame, outlines: tuple[Outline, ...]) -> None:
        pass

    def answer(self, offered: tuple[Answer, ...], wait_s: float) -> Answer | None:
        newest = self.events[-1]
        answer = self._react(newest, offered)
        if answer is None and _in_order(newest) and Answer.go in offered:
            answer = Answer.go
        assert answer is not None or wait_s < 100, f"nobody answers {newest}"
        if answer is not None:
            assert answer in offered
            self.prompts += Answer.go in offered
        return answer

    def sentences(self, step_id: str) -> list[str]:
        """What was said to be wrong in looks and verdicts of a step, each once."""
        told = [e for e in self.events if isinstance(e, ReadingsEvent | VerdictEvent) and e.step_id == step_id]
        return list(
            dict.fromkeys(e.sentence for e in told if e.sentence and not (isinstance(e, VerdictEvent) and e.ok))
        )

    @property
    def visited(self) -> list[str]:
        return [event.id for event in self.events if isinstance(event, StepEvent)]

    @property
    def done(self) -> DoneEvent:
        (done,) = (event for event in self.events if isinstance(event, DoneEvent))
        return done


def _in_order(event: Event) -> bool:
    match event:
        case ReadingsEvent(readings=readings, sentence=sentence):
            return in_order(readings, sentence)
        case VerdictEvent(ok=ok):
            return ok
    return False
