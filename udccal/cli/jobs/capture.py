"""Capturing a session through the procedures that are installed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from udccal.cameras.simulated import SimulatedCamera
from udccal.cli.output import Output
from udccal.displays.simulated import SimulatedDisplay
from udccal.plugins import find_procedure
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName
from udccal.sessions.writer import SessionWriter
from udccal.simulation.truth import draw_truth
from udccal.simulation.world import SimulatedWorld


def simulated_rig(rig: RigDescription, seed: int) -> SimulatedWorld:
    """A simulated rig of that description; another seed is another specimen."""
    return SimulatedWorld(draw_truth(rig, seed))


def capture(output: Output, rig: RigDescription, world: SimulatedWorld, path: Path, terms: Sequence[TermName]) -> None:
    """Capture the steps of the terms that the session does not hold yet, on a simulated rig.

    Raises:
        UdccalError: when a procedure is not installed.
        CaptureError: when the camera does not see what a step needs.
        SessionError: when the folder holds another rig's session.
    """
    with SimulatedCamera(world) as camera:
        display = SimulatedDisplay(world)
        writer = SessionWriter.create_or_resume(path, rig, camera.identity)
        for term in (name for name in get_args(TermName) if name in terms):
            with output.stage(f"capturing {term}") as stage:
                procedure = find_procedure(term)()

                def progress(at: Any) -> None:
                    stage.update(at.done, at.total)

                procedure.run(camera, display, world, writer, progress)
