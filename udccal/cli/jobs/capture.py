"""Capturing a session with bars and sentences for the person watching."""

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
    """``udccal.benches.capture.capture`` with a stage per term; the same errors."""
    with SessionWriter.create_or_resume(path, bench.rig, bench.camera.identity, exchanged, bench.now) as writer:
        _say_damage(output, writer)
        for term in (name for name in TERMS if name in terms):
            with output.stage(f"capturing {term}") as stage:
                capture_term(writer, bench, term, stage.update)


def _say_damage(output: Output, writer: SessionWriter) -> None:
    if writer.recovered:
        output.say(
            "The session's manifest was damaged; going on from the copy kept before the last step. The damaged one is "
            "kept as session.damaged.json."
        )
    for damage in writer.damage:
        output.say(f"Damaged: {damage}; that step has to be captured again.")
