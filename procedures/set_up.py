"""Steps in a row that one set-up by a person covers, guided: looked at while it is set up, captured when told to."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from itertools import groupby
from typing import final

from procedures.live import LONGEST_S, LiveFrames
from procedures.metering import trial_frame
from procedures.plans import Fixed, Metered, TimesThatOf
from procedures.readings import (
    STILL_LOOKS,
    CornersSeen,
    evenness,
    find_corners,
    head_room,
    lean,
    light_leak,
    movement,
    sharpness,
    why_not,
)
from procedures.step import Bench, Step, exposure_of, run_step, set_up
from udccal.arrangements import Board, Dark, FlatLight, Stage
from udccal.cameras.protocol import Camera, Frame
from udccal.displays.protocol import Display
from udccal.errors import CaptureError
from udccal.guide.drawing import side_view
from udccal.guide.events import Outline, Reading
from udccal.guide.steps import GuidedStep, Look
from udccal.planned_steps import with_small_panel
from udccal.rig import RigDescription
from udccal.sessions.writer import SessionWriter

Steps = Callable[[RigDescription], Iterator[Step]]
# Level at which a light is looked at where the step itself takes up another's exposure.
_LOOKED_AT = Metered(0.5)


def set_ups(rig: RigDescription, steps: Steps) -> Iterator[GuidedStep]:
    """Yield one guided step for steps in a row that have the same instruction.

    Args:
        rig: gives the drawing.
        steps: of a procedure; made anew for each use, since pictures of a panel are large.
    """
    for _, alike in groupby(steps(with_small_panel(rig)), key=lambda step: step.instruction):
        yield _guided(rig, steps, tuple(alike))


def _guided(rig: RigDescription, steps: Steps, alike: tuple[Step, ...]) -> GuidedStep:
    first, step_ids = alike[0], tuple(step.id for step in alike)
    needs = {step.exposure.step_id for step in alike if isinstance(step.exposure, TimesThatOf)}
    shortest_s, longest_s = rig.camera.min_exposure_s, rig.camera.max_exposure_s

    def begin(camera: Camera, display: Display, stage: Stage, writer: SessionWriter) -> SetUpVisit:
        return SetUpVisit(steps, step_ids, Bench(camera, display, stage), writer)

    return GuidedStep(
        id=first.id,
        term=first.term,
        title=first.title or first.id,
        why=first.why,
        instruction=first.instruction,
        drawing=side_view(rig, first.arrangement),
        step_ids=step_ids,
        needs=tuple(sorted(needs - set(step_ids))),
        frames=sum(len(step.plan.exposures_s(shortest_s, longest_s)) for step in alike),
        by_itself=False,
        begin=begin,
    )


@final
class SetUpVisit:
    """Implements ``udccal.guide.steps.Visit``: looks at the first step that is missing, captures all that are."""

    def __init__(self, steps: Steps, step_ids: tuple[str, ...], bench: Bench, writer: SessionWriter) -> None:
        self._rig = writer.manifest.rig
        self._steps, self._step_ids, self._bench, self._writer = steps, step_ids, bench, writer
        self._shown = next(step for step in self._missing())
        set_up(self._shown, bench, writer)
        plan = self._shown.exposure if isinstance(self._shown.exposure, Metered) else _LOOKED_AT
        self._live = LiveFrames(bench.camera, self._shown.region, plan, self._rig)
        self._target = plan.target
        self._seen: deque[CornersSeen] = deque(maxlen=STILL_LOOKS)

    def look(self) -> Look:
        """Take a frame of what stands before the camera, and say whether it is what the step needs."""
        arrangement = self._shown.arrangement
        if isinstance(arrangement, Dark):
            frame = trial_frame(self._bench.camera, self._shown.region, self._dark_s())
            return self._judged(frame, (light_leak(frame, self._rig),))
        frame, level = self._live.next()
        room = head_room(level, self._target)
        match arrangement:
            case FlatLight():
                return self._judged(frame, (room, evenness(frame, self._rig)))
            case Board(spec):
                self._seen.append(seen := find_corners(frame, spec))
                resting = (movement(self._seen), lean(seen, spec, self._rig))
                return self._judged(frame, (room, seen.reading(spec), *resting, sharpness(frame)), seen.outlines)
            case _:
                return self._judged(frame, (room,))

    def capture(self) -> Iterator[int]:
        """Capture the missing steps in their order; raises as ``run_step`` does."""
        before: str | None = None
        for step in self._steps(self._rig):
            if step.id in self._step_ids and step.id not in self._writer.completed_ids:
                start_s = exposure_of(before, self._writer)
                run_step(step, self._bench, self._writer, start_s, self._steps(self._rig))
                yield 0
            before = step.id

    def _missing(self) -> Iterator[Step]:
        done = self._writer.completed_ids
        return (step for step in self._steps(self._rig) if step.id in self._step_ids and step.id not in done)

    def _dark_s(self) -> float:
        match self._shown.exposure:
            case TimesThatOf(step_id, factor):
                wanted = factor * (exposure_of(step_id, self._writer) or LONGEST_S)
            case Fixed(exposure_s):
                wanted = exposure_s
            case Metered():
                wanted = LONGEST_S
        return min(max(wanted, self._rig.camera.min_exposure_s), LONGEST_S)

    def _judged(self, frame: Frame, readings: tuple[Reading, ...], outlines: tuple[Outline, ...] = ()) -> Look:
        wrong = [reading for reading in readings if not reading.ok]
        if not wrong:
            return Look(frame, readings, "", outlines)
        if wrong[0].name == "head-room":  # what else is read from such a frame says little
            return Look(frame, readings, why_not(wrong[0]), outlines)
        try:
            self._shown.check(frame, self._rig)
        except CaptureError as error:
            return Look(frame, readings, str(error), outlines)
        return Look(frame, readings, why_not(wrong[0]), outlines)
