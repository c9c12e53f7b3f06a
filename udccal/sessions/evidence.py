"""What a profile keeps of the captures that a term was fitted to."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from udccal.result import Captures
from udccal.sessions.schema import PanelSubject, StoredStep


def captures_of(steps: Sequence[StoredStep]) -> Captures:
    """Return digest, counts, gain and times of a term's steps, of which there must be one at least.

    The digest is the SHA-256 of the sorted checksums of all files, the panel's pictures included, one a line. The order
    of capture and the session's name do not change it.
    """
    captures = [capture for step in steps for capture in step.captures]
    sums = [capture.sha256 for capture in captures]
    sums += [step.subject.picture_sha256 for step in steps if isinstance(step.subject, PanelSubject)]
    gains, times = [capture.gain_dB for capture in captures], [step.completed_at for step in steps]
    return Captures(
        sha256=hashlib.sha256("\n".join(sorted(sums)).encode()).hexdigest(),
        files=len(sums),
        frames=sum(capture.frames for capture in captures),
        gain_dB=(min(gains), max(gains)),
        completed_at=(min(times), max(times)),
    )
