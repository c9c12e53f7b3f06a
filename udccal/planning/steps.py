"""The steps that a procedure would take for a rig, at the exposures that are expected, and their cost."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, final

from udccal.arrangements import Arrangement, Led, PanelPicture
from udccal.errors import UdccalError
from udccal.plugins import find_procedure
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName

# Exposures at which an LED and the panel usually fill the well of their brightest sample.
_LED_FULL_S, PANEL_FULL_S = 125e-6, 0.1


@final
@dataclass(frozen=True)
class PlannedStep:
    """One step as it will be carried out.

    Attributes:
        exposures_s: exposure of every frame that is kept.
        level: of the range from black to saturation that the brightest sample of the first frame reaches in the light
            that the exposure was metered in; 0 where the exposure does not aim at a level.
        test_frames: frames at the first exposure, taken to find it and to check the scene.
    """

    id: str
    arrangement: Arrangement
    instruction: str
    exposures_s: tuple[float, ...]
    level: float
    test_frames: int


@final
@dataclass(frozen=True)
class Cost:
    """Cost of a capture: frames of the camera, the camera's time for them in seconds, and set-ups by a person."""

    frames: int = 0
    seconds: float = 0.0
    set_ups: int = 0

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.frames + other.frames, self.seconds + other.seconds, self.set_ups + other.set_ups)

    def __sub__(self, other: Cost) -> Cost:
        return Cost(self.frames - other.frames, self.seconds - other.seconds, self.set_ups - other.set_ups)


def steps_at(term: TermName, rig: RigDescription, panel_full_s: float = PANEL_FULL_S) -> Iterator[PlannedStep]:
    """The steps of a term's procedure for a rig's captures, one at a time, at the expected exposures.

    At ``panel_full_s`` seconds the brightest sample of a white picture on the panel fills its well.

    Raises:
        UdccalError: when no procedure is installed, or a step of it does not state its frames and exposure.
    """
    steps: Any = find_procedure(term)().steps(rig)
    shortest_s, longest_s = rig.camera.min_exposure_s, rig.camera.max_exposure_s
    full_s, earlier = {Led: _LED_FULL_S, PanelPicture: panel_full_s}, dict[str, Any]()
    for step in steps:
        try:
            # Nothing is metered where the exposure has no target. Flats and boards fill the wells within a frame.
            well_s = full_s.get(type(step.arrangement), 1.0 / rig.camera.frame_rate_hz)
            metered_s = min(max(getattr(step.exposure, "target", 0.0) * well_s, shortest_s), longest_s)
            at = step.exposure.planned(metered_s, earlier)
            exposures_s = step.plan.exposures_s(min(max(at.exposure_s, shortest_s), longest_s), longest_s)
        except (AttributeError, KeyError) as error:
            raise UdccalError(
                f"Expected the step '{step.id}' to tell how many frames it takes and at which exposure, found that it "
                f"does not ({error}). Give its plan and exposure the methods of those in procedures.plans."
            ) from error
        earlier[step.id] = at
        yield PlannedStep(step.id, step.arrangement, step.instruction, exposures_s, at.level or 0.0, at.test_frames)
