"""The steps that the procedures would take for a rig, the time of their frames, and the set-ups by a person."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, final

from udccal.arrangements import Arrangement
from udccal.errors import UdccalError
from udccal.planning.state import RigState, full_s
from udccal.plugins import find_procedure
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName

# The time of a capture does not depend on the panel's picture: pictures are drawn this small for counting.
_COUNTING_PX = 8


@final
@dataclass(frozen=True)
class PlannedStep:
    """One step as it will be carried out.

    Attributes:
        exposures_s: exposure of every frame that is kept.
        level: of the range from black to saturation that the brightest sample of the first frame reaches in the light
            that the exposure was metered in; None where the exposure does not aim at a level.
        test_frames: frames at the first exposure, taken to find it and to check the scene.
    """

    id: str
    arrangement: Arrangement
    instruction: str
    exposures_s: tuple[float, ...]
    level: float | None
    test_frames: int


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
    """The steps of a term's procedure, one at a time, at the expected exposures.

    Raises:
        UdccalError: when no procedure is installed, or a step of it does not state its frames and exposure.
    """
    steps: Any = find_procedure(term)().steps(state.rig)
    longest_s = state.rig.camera.max_exposure_s
    earlier: dict[str, Any] = {}
    for step in steps:
        try:
            at = step.exposure.planned(_metered_s(step, state), earlier)
            exposures_s = step.plan.exposures_s(_within(at.exposure_s, state.rig), longest_s)
        except (AttributeError, KeyError) as error:
            raise UdccalError(
                f"Expected the step '{step.id}' to tell how many frames it takes and at which exposure, found that it "
                f"does not ({error}). Give its plan and exposure the methods of those in procedures.plans."
            ) from error
        earlier[step.id] = at
        yield PlannedStep(step.id, step.arrangement, step.instruction, exposures_s, at.level, at.test_frames)


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


def _metered_s(step: Any, state: RigState) -> float:
    """Exposure in seconds that metering is expected to find; 0 where nothing is metered."""
    target = getattr(step.exposure, "target", 0.0)
    return _within(target * full_s(step.arrangement, state), state.rig)


def _within(exposure_s: float, rig: RigDescription) -> float:
    return min(max(exposure_s, rig.camera.min_exposure_s), rig.camera.max_exposure_s)


def without_pictures(state: RigState) -> RigState:
    """The same state with a tiny panel, on which the frames and exposures of its steps do not depend."""
    small = state.rig.panel.model_copy(update={"columns": _COUNTING_PX, "rows": _COUNTING_PX})
    return replace(state, rig=state.rig.model_copy(update={"panel": small}))
