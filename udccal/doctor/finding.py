"""The result of a check."""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace
from typing import final


class Status(enum.StrEnum):
    """State of one topic."""

    OK = "ok"
    NOTE = "note"  # worth knowing; nothing that the user asked for fails
    PROBLEM = "PROBLEM"  # something that the user asked for cannot work


@final
@dataclass(frozen=True)
class Finding:
    """One row of the doctor's table.

    Attributes:
        topic: what was checked.
        found: the result, as a phrase.
        advice: what to do, with commands on separate lines; empty when there is nothing to do.
    """

    topic: str
    status: Status
    found: str
    advice: str = ""

    def needed(self, asked: bool) -> Finding:
        """Return the finding with a note turned into a problem when the user asked for the topic."""
        return replace(self, status=Status.PROBLEM) if asked and self.status is Status.NOTE else self
