"""What a check found."""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace
from typing import final


class Status(enum.StrEnum):
    """How it stands with one topic."""

    OK = "ok"
    NOTE = "note"  # worth knowing; nothing that was asked for fails
    PROBLEM = "PROBLEM"  # something that was asked for cannot work


@final
@dataclass(frozen=True)
class Finding:
    """One row of the doctor's table.

    Attributes:
        topic: what was looked at.
        found: what is the case, in a phrase.
        advice: what to do, with the commands on lines of their own; empty when there is nothing to do.
    """

    topic: str
    status: Status
    found: str
    advice: str = ""

    def needed(self, asked: bool) -> Finding:
        """The same, and a problem instead of a note when it was asked for."""
        return replace(self, status=Status.PROBLEM) if asked and self.status is Status.NOTE else self
