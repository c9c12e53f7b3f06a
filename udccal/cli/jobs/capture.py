"""Captures a session with progress bars and messages."""

from __future__ import annotations

from collections.abc import Sequence, Set
from pathlib import Path

from udccal.benches.bench import CaptureBench
from udccal.benches.capture import TERMS, capture_term
from udccal.cli.output import Output
from udccal.sessions.changes import Exchanged
from udccal.sessions.schema import TermName
from udccal.sessions.writer import SessionWriter


def capture_watched(
    output: Output,
    bench: CaptureBench,
    path: Path,
    terms: Sequence[TermName],
    exchanged: Set[Exchanged] = frozenset(),
) -> None:
    """Capture a session with one stage per term.

    Args:
        output: shows stages and messages.
        bench: camera, display and stage.
        path: folder of the session.
        terms: terms to capture.
        exchanged: parts of the rig that were exchanged on purpose since the session began.

    Raises:
        UdccalError: as ``udccal.benches.capture.capture`` does.
    """
    with SessionWriter.create_or_resume(path, bench.rig, bench.camera.identity, exchanged, bench.now) as writer:
        _say_damage(output, writer)
        for term in (name for name in TERMS if name in terms):
            with output.stage(f"capturing {term}") as stage:
                capture_term(writer, bench, term, stage.update)


def _say_damage(output: Output, writer: SessionWriter) -> None:
    if writer.recovered:
        output.say(
            "The session's manifest was damaged; the copy from before the last step replaces it. The damaged one is "
            "kept as session.damaged.json."
        )
    for damage in writer.damage:
        output.say(f"Damaged: {damage}; that step has to be captured again.")
