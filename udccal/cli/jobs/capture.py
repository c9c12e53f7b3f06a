"""Captures a session with progress bars and messages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import final

from udccal.benches.bench import CaptureBench
from udccal.benches.capture import TERMS, capture_term
from udccal.cli.output import Output
from udccal.errors import SessionError, did_you_mean
from udccal.sessions.changes import Exchanged
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter


@final
@dataclass(frozen=True)
class Wanted:
    """What is to be captured.

    Attributes:
        session: its folder.
        terms: terms to capture.
        exchanged: parts of the rig that were exchanged on purpose since the session began.
        again: ids of captured steps to capture once more; each stays until its new captures are whole.
        before: called with the rig when it is there, before anything is captured; what it raises ends the capture.
    """

    session: Path
    terms: Sequence[TermName]
    exchanged: Set[Exchanged] = frozenset()
    again: Collection[str] = ()
    before: Callable[[CaptureBench], None] | None = None

    @property
    def pictures(self) -> Path:
        """Folder beside the session for pictures that a person shows on the panel."""
        session = self.session.resolve()
        return session.with_name(f"{session.name}-pictures")


def capture_watched(output: Output, bench: CaptureBench, wanted: Wanted) -> None:
    """Capture a session with one stage per term.

    Raises:
        UdccalError: as ``udccal.benches.capture.capture`` does.
        SessionError: as ``open_session`` and ``refuse_unknown`` do.
    """
    with open_session(output, bench, wanted) as writer:
        for term in (name for name in TERMS if name in wanted.terms):
            with output.stage(f"capturing {term}") as stage:
                capture_term(writer, bench, term, stage.update)
        refuse_unknown(writer)


@contextmanager
def open_session(output: Output, bench: CaptureBench, wanted: Wanted) -> Iterator[SessionWriter]:
    """Begin or continue a session, and say what is damaged in it.

    Raises:
        UdccalError: as ``wanted.before`` does; nothing has been captured then.
        SessionError: when a step of ``wanted.again`` was not captured, or is of another term; also from the session.
    """
    if wanted.before is not None:
        wanted.before(bench)
    if wanted.again:
        _check_captured(Session.open(wanted.session), wanted.again, wanted.terms)
    with SessionWriter.create_or_resume(
        wanted.session, bench.rig, bench.camera.identity, wanted.exchanged, bench.now
    ) as writer:
        _say_damage(output, writer)
        writer.capture_again(wanted.again)
        yield writer


def refuse_unknown(writer: SessionWriter) -> None:
    """Refuse steps that were to be captured again and that no procedure has come to.

    Raises:
        SessionError: when there are any.
    """
    if writer.again:
        raise SessionError(
            f"Expected the rig's procedures to have the steps {', '.join(sorted(writer.again))} of {writer.path}, "
            "found none with these names. They stay as they are."
        )


def _check_captured(session: Session, again: Collection[str], terms: Sequence[TermName]) -> None:
    """Refuse steps that were not captured, or are of terms that are not asked for, before anything else is done."""
    captured = {step.id: step.term for step in session.manifest.steps}
    for step_id in again:
        term = captured.get(step_id)
        if term is None:
            meant = did_you_mean(step_id, captured)
            raise SessionError(
                f"Expected the step '{step_id}' in the session {session.path}, found that it was not captured.{meant} "
                "Steps that are missing are captured without --again."
            )
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
