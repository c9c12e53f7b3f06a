"""The steps that the procedures would take for a rig, the time of their frames, and the set-ups by a person."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import final

from udccal.planning.exposures import PlannedStep, steps_at, with_small_panel
from udccal.planning.state import RigState, full_s
from udccal.sessions.schema import TermName


@final
@dataclass(frozen=True)
class Cost:
    """Cost of a capture: frames of the camera, the camera's time for them in seconds, and set-ups by a person."""

    frames: int
    seconds: float
    set_ups: int

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.frames + other.frames, self.seconds + other.seconds, self.set_ups + other.set_ups)

    def __sub__(self, other: Cost) -> Cost:
        return Cost(self.frames - other.frames, self.seconds - other.seconds, self.set_ups - other.set_ups)


NOTHING = Cost(0, 0.0, 0)


def planned_steps(term: TermName, state: RigState) -> Iterator[PlannedStep]:
    """The steps of a term's procedure at the exposures of a rig's state; raises as ``steps_at`` does."""
    return steps_at(term, state.rig, lambda arrangement: full_s(arrangement, state))


def cost_of(term: TermName, state: RigState) -> Cost:
    """Frames, seconds and set-ups of a term's procedure; it raises the errors of ``planned_steps``."""
    total, standing = NOTHING, ""
    for step in planned_steps(term, without_pictures(state)):
        period_s = 1.0 / state.rig.camera.frame_rate_hz
        seconds = sum(max(period_s, exposure_s) for exposure_s in step.exposures_s)
        seconds += step.test_frames * max(period_s, step.exposures_s[0])
        # A person is asked when the instruction changes; pictures of the panel follow each other by themselves.
        total += Cost(len(step.exposures_s) + step.test_frames, seconds, int(step.instruction != standing))
        standing = step.instruction
    return total


def without_pictures(state: RigState) -> RigState:
    """The same state with a tiny panel, for counting."""
    return replace(state, rig=with_small_panel(state.rig))
