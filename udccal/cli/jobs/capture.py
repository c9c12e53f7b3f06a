"""Captures a session with progress bars and messages."""

from __future__ import annotations

from collections.abc import Collection, Sequence, Set
from pathlib import Path

from udccal.benches.bench import CaptureBench
from udccal.benches.capture import TERMS, capture_term
from udccal.cli.output import Output
from udccal.errors import SessionError
from udccal.sessions.changes import Exchanged
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter


def capture_watched(
    output: Output,
    bench: CaptureBench,
    path: Path,
    terms: Sequence[TermName],
    exchanged: Set[Exchanged] = frozenset(),
    again: Collection[str] = (),
) -> None:
    """Capture a session with one stage per term.

    Args:
        output: shows stages and messages.
        bench: camera, display and stage.
        path: folder of the session.
        terms: terms to capture.
        exchanged: parts of the rig that were exchanged on purpose since the session began.
        again: ids of captured steps to capture once more; each stays until its new captures are whole.

    Raises:
        UdccalError: as ``udccal.benches.capture.capture`` does.
        SessionError: when a step of ``again`` was not captured, or is none of the terms' steps.
    """
    if again:
        _check_captured(Session.open(path), again, terms)
    with SessionWriter.create_or_resume(path, bench.rig, bench.camera.identity, exchanged, bench.now) as writer:
        _say_damage(output, writer)
        writer.capture_again(again)
        for term in (name for name in TERMS if name in terms):
            with output.stage(f"capturing {term}") as stage:
                capture_term(writer, bench, term, stage.update)
        if writer.again:
            raise SessionError(
                f"Expected the rig's procedures to have the steps {', '.join(sorted(writer.again))} of {path}, found "
                "none with these names. They stay as they are."
            )


def _check_captured(session: Session, again: Collection[str], terms: Sequence[TermName]) -> None:
    """Refuse steps that were not captured, or are of terms that are not asked for, before anything else is done."""
    for step_id in again:
        term = session.step(step_id).term
        if term not in terms:
            raise SessionError(
                f"Expected steps of the terms {', '.join(terms)}, found '{step_id}' of {term}. Add --term {term}."
            )


def _say_damage(output: Output, writer: SessionWriter) -> None:
    if writer.recovered:
        output.say(
            "The session's manifest was damaged; the copy from before the last step replaces it. The damaged one is "
            "kept as session.damaged.json."
        )
    for damage in writer.damage:
        output.say(f"Damaged: {damage}; that step has to be captured again.")
