"""Capturing a session through the procedures that are installed."""

from __future__ import annotations

from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any, get_args

from udccal.cli.jobs.benches import CaptureBench
from udccal.cli.output import Output
from udccal.errors import CameraTimeout, CaptureError, DisplayError
from udccal.plugins import find_procedure
from udccal.rig import RigDescription
from udccal.sessions.changes import Exchanged
from udccal.sessions.schema import TermName
from udccal.sessions.writer import SessionWriter


def capture(
    output: Output,
    rig: RigDescription,
    bench: CaptureBench,
    path: Path,
    terms: Sequence[TermName],
    exchanged: Set[Exchanged] = frozenset(),
) -> None:
    """Capture the steps of the terms that the session does not hold yet, or no longer whole.

    Raises:
        UdccalError: when a procedure is not installed.
        CaptureError: when the camera does not see what a step needs.
        SessionError: when the folder holds another rig's or camera's session, or another process writes to it.
    """
    with SessionWriter.create_or_resume(path, rig, bench.camera.identity, exchanged, bench.now) as writer:
        _say_damage(output, writer)
        for term in (name for name in get_args(TermName) if name in terms):
            with output.stage(f"capturing {term}") as stage:
                procedure = find_procedure(term)()

                def progress(at: Any) -> None:
                    stage.update(at.done, at.total)

                while True:
                    try:
                        procedure.run(bench.camera, bench.display, bench.stage, writer, progress)
                        break
                    except (CaptureError, CameraTimeout, DisplayError) as error:
                        if not bench.try_again(str(error)):
                            raise


def _say_damage(output: Output, writer: SessionWriter) -> None:
    if writer.recovered:
        output.say(
            "The session's manifest was damaged; going on from the copy kept before the last step. The damaged one is "
            "kept as session.damaged.json."
        )
    for damage in writer.damage:
        output.say(f"Damaged: {damage}; that step has to be captured again.")
