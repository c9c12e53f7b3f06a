"""Why the tests on the real USB stack did not run."""

from __future__ import annotations

from typing import final


@final
class CannotRun(Exception):
    """Something that the harness needs is not there; the text says what, and how to get it."""


@final
class GuestFailed(Exception):
    """The guest did not boot, did not end, or ran no test; the text says which."""
