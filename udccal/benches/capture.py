"""Capturing a session through the procedures that are installed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Set
from functools import partial
from pathlib import Path
from typing import Any, get_args

from udccal.benches.bench import CaptureBench
from udccal.errors import CameraTimeout, CaptureError, DisplayError
from udccal.plugins import find_procedure
from udccal.sessions.changes import Exchanged
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

TERMS: tuple[TermName, ...] = get_args(TermName)


def capture(
    path: str | Path,
    bench: CaptureBench,
    terms: Iterable[TermName] = TERMS,
    progress: Callable[[TermName, int, int | None], None] = lambda term, done, total: None,
    exchanged: Set[Exchanged] = frozenset(),
) -> Session:
    """Capture the steps of the terms that the session does not hold yet, or no longer whole.

    It may be stopped at any moment: called again with the same arguments it goes on.

    Args:
        path: folder of the session; made where there is none.
        bench: camera, display and stage, such as ``udccal.simulate`` gives.
        terms: which to capture, in any order.
        progress: called with the term, the steps done, and of how many.
        exchanged: parts of the rig that were exchanged since the session began, and may be.

    Raises:
        UdccalError: when a procedure is not installed.
        CaptureError: when the camera does not see what a step needs.
        SessionError: when the folder holds another rig's or camera's session, or another process writes to it.
    """
    wanted = set(terms)
    with SessionWriter.create_or_resume(Path(path), bench.rig, bench.camera.identity, exchanged, bench.now) as writer:
        for term in (name for name in TERMS if name in wanted):
            capture_term(writer, bench, term, partial(progress, term))
    return Session.open(path)


def capture_term(
    writer: SessionWriter, bench: CaptureBench, term: TermName, progress: Callable[[int, int | None], None]
) -> None:
    """Run one term's procedure, again where the bench says so; errors as for ``capture``."""
    procedure = find_procedure(term)()

    def report(at: Any) -> None:
        progress(at.done, at.total)

    while True:
        try:
            procedure.run(bench.camera, bench.display, bench.stage, writer, report)
            return
        except (CaptureError, CameraTimeout, DisplayError) as error:
            if not bench.try_again(str(error)):
                raise
