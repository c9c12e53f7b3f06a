"""A guided capture of a rig: its steps, how long they take, and leading a person through them."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from udccal.benches.bench import CaptureBench
from udccal.benches.capture import TERMS
from udccal.cameras.choice import check_camera
from udccal.guide.events import DoneEvent, Person
from udccal.guide.lead import Leading
from udccal.guide.steps import GuidedStep
from udccal.planned_steps import with_small_panel
from udccal.planning.steps import steps_at
from udccal.plugins import find_procedure
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName
from udccal.sessions.writer import SessionWriter

# What a person takes, apart from the camera: to set something up, and to move an LED or a board a little.
_SET_UP_S, _MOVE_S = 45.0, 6.0


def guided_steps(rig: RigDescription, terms: Iterable[TermName] = TERMS) -> tuple[GuidedStep, ...]:
    """Return what a person is led through, in the order in which terms are captured.

    Args:
        rig: as built, with the captures that are wanted.
        terms: terms to capture, in any order.

    Raises:
        UdccalError: when a procedure is not installed.
    """
    wanted = set(terms)
    return tuple(step for term in TERMS if term in wanted for step in find_procedure(term)().guided(rig))


def expected_seconds(rig: RigDescription, steps: Collection[GuidedStep]) -> tuple[float, ...]:
    """Return how long each step is expected to take: the camera's time as it is planned, and a person's.

    Raises:
        UdccalError: when a step of a procedure does not tell how many frames it takes.
    """
    period_s, small = 1.0 / rig.camera.frame_rate_hz, with_small_panel(rig)
    camera_s = {
        step.id: sum(max(period_s, exposure_s) for exposure_s in step.exposures_s)
        for term in {step.term for step in steps}
        for step in steps_at(term, small)
    }
    return tuple(
        sum(camera_s.get(step_id, 0.0) for step_id in step.step_ids)
        + (_MOVE_S * len(step.step_ids) if step.by_itself else _SET_UP_S)
        for step in steps
    )


def lead_capture(
    writer: SessionWriter, bench: CaptureBench, person: Person, terms: Iterable[TermName] = TERMS
) -> DoneEvent:
    """Lead a person through the steps that a session lacks.

    Args:
        writer: the open session.
        bench: camera, display and stage; the stage of a real rig is ``udccal.guide.people.ByHand``.
        person: who is led.
        terms: terms to capture, in any order.

    Returns:
        the event that the person was told last.

    Raises:
        CameraError: when the camera does not fit the rig, or fails.
        SessionError: from the writer.
        UdccalError: when a procedure is not installed.
    """
    check_camera(bench.camera, bench.rig)
    steps = guided_steps(bench.rig, terms)
    return Leading(steps, expected_seconds(bench.rig, steps), bench, writer, person).run()
