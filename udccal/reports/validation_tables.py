"""Tables of a validation, the same for the terminal and the page."""

from __future__ import annotations

from collections.abc import Sequence

from udccal.reports.tables import Table
from udccal.validation.checks import Check


def checks_table(checks: Sequence[Check]) -> Table:
    """Return the checks with their values and limits."""
    rows = tuple((one.term, *_columns(one)) for one in checks)
    return Table("Checks", ("term", "check", "value", "limit", ""), rows, frozenset({2, 3}))


def term_checks_table(checks: Sequence[Check]) -> Table:
    """Return the checks of one term."""
    return Table("Checks", ("check", "value", "limit", ""), tuple(_columns(one) for one in checks), frozenset({1, 2}))


def _columns(one: Check) -> tuple[str, str, str, str]:
    return one.name, _number(one.value, one.unit), _number(one.limit, ""), said(one)


def said(check: Check) -> str:
    """Return a check's outcome in a word or two."""
    return "not counted" if check.ok is None else "ok" if check.ok else "failed"


def _number(value: float | None, unit: str) -> str:
    return "–" if value is None else f"{value:.3g} {unit if unit != '1' else ''}".strip()
