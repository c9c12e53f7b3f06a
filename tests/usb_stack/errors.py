"""Why the tests on the real USB stack cannot run."""

from __future__ import annotations

from typing import final


@final
class CannotRun(Exception):
    """Something that the harness needs is not there; the text says what, and how to get it."""
