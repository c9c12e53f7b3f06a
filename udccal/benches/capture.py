"""Captures a session through the installed procedures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Set
from functools import partial
from pathlib import Path
from typing import Any, get_args

from udccal.arguments import check_is_path, check_kind
from udccal.benches.bench import CaptureBench
from udccal.errors import CameraError, SessionError, UdccalError
from udccal.plugins import find_procedure
from udccal.sessions.changes import Exchanged
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

TERMS: tuple[TermName, ...] = get_args(TermName)


def capture(
    path: str | Path,
    bench: CaptureBench,
    terms: str | Iterable[str] = TERMS,
    progress: Callable[[TermName, int, int | None], None] = lambda term, done, total: None,
    exchanged: Set[Exchanged] = frozenset(),
) -> Session:
    """Capture the steps of the terms that are missing or damaged in the session.

    It may be stopped at any moment; called again with the same arguments it continues.

    Args:
        path: folder of the session; created if missing.
        bench: camera, display and stage, such as ``udccal.simulate`` returns.
        terms: one term or several, in any order, of noise, geometry, wire, psf and backscatter.
        progress: gets the term, the number of steps done, and their total.
        exchanged: parts of the rig that were exchanged on purpose since the session began: ``camera``, ``lens``.

    Returns:
        the session, open for reading.

    Raises:
        UdccalError: when a procedure is not installed, or one of ``terms`` is not the name of a term.
        CameraError: when the camera does not fit the rig.
        CaptureError: when the camera does not see what a step needs.
        SessionError: when the folder holds another rig's or camera's session, or another process writes to it.
    """
    check_is_path(path, "a session", SessionError)
    check_kind(bench, CaptureBench, "Open one by udccal.simulate(rig), or of your own devices.", CameraError)
    wanted = {terms} if isinstance(terms, str) else set(terms)
    if unknown := wanted - set(TERMS):
        raise UdccalError(f"Expected terms, of {', '.join(TERMS)}, found '{min(unknown)}'. Name some of these.")
    with SessionWriter.create_or_resume(Path(path), bench.rig, bench.camera.identity, exchanged, bench.now) as writer:
        for term in (name for name in TERMS if name in wanted):
            capture_term(writer, bench, term, partial(progress, term))
    return Session.open(path)


def capture_term(
    writer: SessionWriter, bench: CaptureBench, term: TermName, progress: Callable[[int, int | None], None]
) -> None:
    """Run one term's procedure.

    Args:
        writer: open session.
        bench: camera, display and stage.
        term: term to capture.
        progress: gets the number of steps done, and their total or None.

    Raises:
        UdccalError: as ``capture`` does.
    """
    procedure = find_procedure(term)()

    def report(at: Any) -> None:
        progress(at.done, at.total)

    procedure.run(bench.camera, bench.display, bench.stage, writer, report)
