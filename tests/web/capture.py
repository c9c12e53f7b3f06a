"""A guided capture that only plays: steps, frames, readings and verdicts, in which a person may do wrong."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from udccal.cameras.protocol import Frame, Region, Settings
from udccal.cfa import cfa_named
from udccal.guide.events import (
    Answer,
    DoneEvent,
    Outline,
    Person,
    ProgressEvent,
    Reading,
    ReadingsEvent,
    StepEvent,
    VerdictEvent,
)
from udccal.web.picture import Sampling

SAMPLING = Sampling(cfa_named("RGGB"), black_DN=64.0, clipped_DN=3900.0)
VERDICT = (Answer.go, Answer.again, Answer.skip, Answer.back, Answer.quit)
READY = (Answer.go, Answer.skip, Answer.back, Answer.quit)
DRAWING = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 400 120"><rect x="120" y="10" width="4" height="100"/>'
    '<path d="M60 50h30v20h-30zM90 60L380 20M90 60L380 100" fill="none" stroke="#246"/>'
    '<text x="130" y="22" font-size="12">panel, 14 mm before the pupil</text></svg>'
)


@final
@dataclass(frozen=True)
class Step:
    """One step of the play: where its light is wanted and where it is at first, in px of the sensor."""

    id: str
    title: str
    instruction: str
    wanted: tuple[tuple[float, float], ...]
    off_px: float


STEPS = (
    Step("noise/dark", "Cap the lens", "Switch the panel off and put the cap on the lens.", (), 0.0),
    Step(
        "psf/led-3",
        "LED in the lower left of the field",
        "Hold the LED two metres from the panel, so that its image rests on the cross.",
        ((420.0, 500.0),),
        90.0,
    ),
    Step(
        "geometry/board-2",
        "Board, turned to the left",
        "Hold the board (12 x 9 squares of 50 mm) in the outline and keep it still.",
        ((300.0, 200.0), (720.0, 160.0), (740.0, 560.0), (310.0, 520.0)),
        40.0,
    ),
)


@functools.lru_cache(maxsize=64)
def frame(columns: int = 1024, rows: int = 768, spot: tuple[float, float] | None = None, seed: int = 0) -> Frame:
    """Return a mosaic with a bright spot at a place, clipped in its middle; without a spot it is dark."""
    rng = np.random.default_rng(seed)
    data = rng.normal(70.0, 4.0, (rows, columns))
    if spot is not None:
        y, x = np.mgrid[:rows, :columns]
        r2 = (x - spot[0]) ** 2 + (y - spot[1]) ** 2
        data += 5000.0 * np.exp(-r2 / 120.0) + 300.0 * np.exp(-r2 / 60000.0)
    settings = Settings(0.01, 0.0, Region(0, 0, columns, rows))
    return Frame(np.clip(data, 0, 4095).astype(np.uint16), settings, 0.0, seed, True)


def moved(points: Sequence[tuple[float, float]], off_px: float) -> tuple[tuple[float, float], ...]:
    return tuple((x + off_px, y - 0.6 * off_px) for x, y in points)


@final
@dataclass
class PlayedCapture:
    """Leads a person through the steps until they end or the person quits.

    Attributes:
        answered: every answer with the step that it was given in, in order.
        looked: frames shown so far.
        stop: ends the play at the next question.
        frames: of a step.
    """

    person: Person
    steps: Sequence[Step] = STEPS
    frames: int = 12
    answered: list[tuple[str, Answer]] = field(default_factory=list)
    looked: int = 0
    beat_s: float = 0.05
    stop: bool = False

    def run(self) -> None:
        place, captured = 0, 0
        while place < len(self.steps):
            step = self.steps[place]
            self._announce(step, place)
            answer = self._aim(step)
            if answer is Answer.go:
                answer = self._take(step)
                captured += answer is Answer.go
            if answer is Answer.quit:
                self.person.tell(DoneEvent(False, True, f"Stopped at {step.title}. The same command continues."))
                return
            place = {Answer.again: place, Answer.back: max(place - 1, 0)}.get(answer, place + 1)
        self.person.tell(DoneEvent(captured == len(self.steps), False, f"Captured {captured} steps."))

    def _announce(self, step: Step, place: int) -> None:
        left = 4.0 * (len(self.steps) - place)
        why = "It tells how light spreads behind the rows of the panel."
        self.person.tell(
            StepEvent(step.id, step.title, why, step.instruction, DRAWING, place + 1, len(self.steps), left)
        )

    def _aim(self, step: Step) -> Answer:
        """Show frames in which the light comes nearer to where it is wanted, until the person says how to go on."""
        for beat in itertools.count():
            off_px = step.off_px * max(1.0 - beat / 60.0, 0.0)
            self._look(step, off_px)
            sentence = f"Move it {off_px:.0f} px to the left." if off_px > 20.0 else ""
            readings = (
                Reading("distance from the cross", off_px, None, 20.0, "px"),
                Reading("head-room", 1.4, 1.1, 4.0, "1"),
                Reading("light of the room", float("nan") if beat < 3 else 2.0, None, 8.0, "DN"),
                Reading("coverage", 0.4, 0.3, None, "1"),
                Reading("exposure", 0.01, None, None, "s"),
            )
            self.person.tell(ReadingsEvent(step.id, readings, sentence))
            if (answer := self._answer(step, READY)) is not None:
                return answer
        raise AssertionError

    def _take(self, step: Step) -> Answer:
        for count in range(1, self.frames + 1):
            self._look(step, 0.0)
            self.person.tell(ProgressEvent(step.id, count, self.frames))
        wrong = step.id == "psf/led-3" and (step.id, Answer.again) not in self.answered
        sentence = "The LED moved by 3 px during a bracket. Rest it on something." if wrong else "The step is captured."
        self.person.tell(VerdictEvent(step.id, not wrong, sentence, VERDICT))
        while (answer := self._answer(step, VERDICT)) is None:
            self._look(step, 0.0)
        return answer

    def _look(self, step: Step, off_px: float) -> None:
        seen = moved(step.wanted, off_px)
        middle = tuple(np.mean(seen, axis=0)) if seen else None
        outlines = (Outline(step.wanted, "wanted"), Outline(seen, "seen")) if seen else ()
        self.person.look(frame(spot=middle, seed=self.looked % 4), outlines)
        self.looked += 1

    def _answer(self, step: Step, offered: tuple[Answer, ...]) -> Answer | None:
        answer = Answer.quit if self.stop else self.person.answer(offered, self.beat_s)
        if answer is not None:
            self.answered.append((step.id, answer))
        return answer
