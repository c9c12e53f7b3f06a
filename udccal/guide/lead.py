"""Leads a person through a capture, step by step, until the session holds all of them or the person stops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from udccal.benches.bench import CaptureBench
from udccal.errors import CameraTimeout, CaptureError, DisplayError
from udccal.guide.events import (
    Answer,
    DoneEvent,
    Person,
    ProgressEvent,
    Quit,
    ReadingsEvent,
    StepEvent,
    VerdictEvent,
)
from udccal.guide.steps import GuidedStep, Look, Visit
from udccal.sessions.writer import SessionWriter

# What a person can mend; anything else ends the capture.
_MENDABLE = (CaptureError, CameraTimeout, DisplayError)
_LOOK_S = 0.1  # wait for an answer between two looks
_LONG_S = 3600.0
_WAITING = (Answer.go, Answer.skip, Answer.back, Answer.quit)
_BY_ITSELF = (Answer.again, Answer.skip, Answer.back, Answer.quit)
_AFTER = (Answer.go, Answer.again, Answer.back, Answer.quit)
_LACKING = (Answer.skip, Answer.back, Answer.quit)


@final
@dataclass(frozen=True)
class Leading:
    """What a person is led through.

    Attributes:
        steps: all of them, those included that the session holds already.
        seconds: how long each is expected to take, set-up included.
        bench: camera, display and stage.
        writer: the open session.
        person: who is led.
    """

    steps: Sequence[GuidedStep]
    seconds: Sequence[float]
    bench: CaptureBench
    writer: SessionWriter
    person: Person

    def run(self) -> DoneEvent:
        """Lead through the missing steps in their order; skipped ones are left out, and those that need them too.

        Returns:
            the event that was told last; it is not complete when steps were skipped or the person has quit.

        Raises:
            UdccalError: when something is wrong that no person at the rig can mend.
        """
        skipped: set[int] = set()
        at = self._next(0, skipped)
        while at is not None:
            match self._visit(at):
                case Answer.quit:
                    return self._done("Stopped; what is captured stays.", stopped=True)
                case Answer.back:
                    at = max(at - 1, 0)
                    skipped.discard(at)
                case Answer.again:
                    pass
                case Answer.skip:
                    skipped.add(at)
                    at = self._next(at + 1, skipped)
                case _:
                    at = self._next(at + 1, skipped)
        left = [self.steps[index].id for index in sorted(skipped) if not self._captured(self.steps[index])]
        if left:
            return self._done(f"Captured, without {', '.join(left)}. The same command captures what was left out.")
        return self._done("Everything is captured.")

    def _done(self, sentence: str, stopped: bool = False) -> DoneEvent:
        event = DoneEvent(all(self._captured(step) for step in self.steps), stopped, sentence)
        self.person.tell(event)
        return event

    def _captured(self, step: GuidedStep) -> bool:
        return self.writer.completed_ids.issuperset(step.step_ids)

    def _next(self, start: int, skipped: set[int]) -> int | None:
        """Return the next step to visit from ``start`` on, then from the first: a repeated step may undo others."""
        order = [*range(start, len(self.steps)), *range(min(start, len(self.steps)))]
        return next((at for at in order if at not in skipped and not self._captured(self.steps[at])), None)

    def _visit(self, at: int) -> Answer:
        """Lead through one step and return how it ended: go on, or what the person answered instead."""
        step = self.steps[at]
        later = [index for index in range(at, len(self.steps)) if not self._captured(self.steps[index])]
        minutes = sum(self.seconds[index] for index in {at, *later}) / 60
        self.person.tell(
            StepEvent(
                step.id,
                step.title,
                step.why,
                step.instruction,
                step.drawing,
                at + 1,
                len(self.steps),
                minutes,
            )
        )
        lacking = [step_id for step_id in step.needs if step_id not in self.writer.completed_ids]
        if lacking:
            sentence = (
                f"This step takes up the exposure of {', '.join(lacking)}, which was not captured. Go back to it."
            )
            return self._verdict(step, False, sentence, _LACKING)
        if self._captured(step):
            self.writer.capture_again(step.step_ids)
        try:
            answer = self._carry_out(step)
        except Quit:  # asked to show a picture
            answer = Answer.quit
        if answer is not Answer.again:  # else the next visit captures what this one has left
            self.writer.keep_captured(step.step_ids)
        return answer

    def _carry_out(self, step: GuidedStep) -> Answer:
        bench = self.bench
        try:
            visit = step.begin(bench.camera, bench.display, bench.stage, self.writer)
        except _MENDABLE as error:
            return self._refused(step, str(error))
        while True:
            look = self._look(step, visit)
            answer = self._asked(step)
            if answer is not None and answer is not Answer.go:
                return answer
            if answer is None and not (step.by_itself and look is not None and look.in_order):
                continue
            try:
                for waiting in visit.capture():
                    self.person.tell(ProgressEvent(step.id, self._frames(step) + waiting, step.frames))
            except _MENDABLE as error:
                if not step.by_itself:
                    return self._refused(step, str(error))
                self.person.tell(ReadingsEvent(step.id, look.readings if look is not None else (), str(error)))
            if self._captured(step):
                sentence = f"{step.title}: {self._frames(step)} frames captured."
                if not step.by_itself:
                    return self._verdict(step, True, sentence, _AFTER)
                said = self._asked(step)  # while the last frames were taken: the verdict ends the question
                self.person.tell(VerdictEvent(step.id, True, sentence, ()))
                return said or Answer.go

    def _look(self, step: GuidedStep, visit: Visit) -> Look | None:
        try:
            look = visit.look()
        except _MENDABLE as error:
            self.person.tell(ReadingsEvent(step.id, (), str(error)))
            return None
        self.person.look(look.frame, look.outlines)
        self.person.tell(ReadingsEvent(step.id, look.readings, look.sentence))
        return look

    def _asked(self, step: GuidedStep) -> Answer | None:
        """Return what the person says at a look; a step that goes by itself waits for nobody."""
        return self.person.answer(_BY_ITSELF, 0.0) if step.by_itself else self.person.answer(_WAITING, _LOOK_S)

    def _refused(self, step: GuidedStep, sentence: str) -> Answer:
        """Say why a step was refused; ``go`` tries again."""
        answer = self._verdict(step, False, sentence, _WAITING)
        return Answer.again if answer is Answer.go else answer

    def _verdict(self, step: GuidedStep, ok: bool, sentence: str, offered: tuple[Answer, ...]) -> Answer:
        self.person.tell(VerdictEvent(step.id, ok, sentence, offered))
        while True:
            answer = self.person.answer(offered, _LONG_S)
            if answer is not None:
                return answer

    def _frames(self, step: GuidedStep) -> int:
        """Return how many frames of a step the session holds."""
        done = self.writer.completed_ids
        stored = (self.writer.step(step_id) for step_id in step.step_ids if step_id in done)
        return sum(capture.frames for each in stored if each is not None for capture in each.captures)
