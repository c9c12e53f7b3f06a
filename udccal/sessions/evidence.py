"""What a profile keeps of the captures that a term was fitted to."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from udccal.result import Captures
from udccal.sessions.schema import PanelSubject, StoredStep

_STEP_DIGITS = 16


def captures_of(steps: Sequence[StoredStep]) -> Captures:
    """Return digests, counts, gain, times and temperature of a term's steps, of which there must be one at least.

    The digest is the SHA-256 of the sorted checksums of all files, the panel's pictures included, one a line. The order
    of capture and the session's name do not change it.
    """
    captures, sums = [capture for step in steps for capture in step.captures], _checksums(steps)
    temperatures = [capture.temperature_C for capture in captures if capture.temperature_C is not None]
    gains, times = [capture.gain_dB for capture in captures], [step.completed_at for step in steps]
    return Captures(
        sha256=_digest(sums),
        files=len(sums),
        frames=sum(capture.frames for capture in captures),
        gain_dB=(min(gains), max(gains)),
        completed_at=(min(times), max(times)),
        temperature_C=(min(temperatures), max(temperatures)) if temperatures else None,
        steps=tuple(sorted(step_digest(step) for step in steps)),
    )


def step_digest(step: StoredStep) -> str:
    """Return the first digits of the same digest of one step, which tell the steps of all sessions apart."""
    return _digest(_checksums([step]))[:_STEP_DIGITS]


def _checksums(steps: Sequence[StoredStep]) -> list[str]:
    sums = [capture.sha256 for step in steps for capture in step.captures]
    return sums + [step.subject.picture_sha256 for step in steps if isinstance(step.subject, PanelSubject)]


def _digest(sums: Sequence[str]) -> str:
    return hashlib.sha256("\n".join(sorted(sums)).encode()).hexdigest()
