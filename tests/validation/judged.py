"""What tests of all terms ask of a term's checks."""

from __future__ import annotations

from udccal.validation.checks import Check, Judged


def named(judged: Judged, name: str) -> Check:
    """The check of this name."""
    return next(check for check in judged.checks if check.name == name)


def failed(judged: Judged) -> set[str]:
    """Names of the checks that failed."""
    return {check.name for check in judged.checks if check.ok is False}
