"""One measured number against its limit, and the table and JSON file made of them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

# How names end whose limit is a lower one.
AT_LEAST = "(at least)"


@dataclass(frozen=True)
class Row:
    """A measured number; ``ok`` says whether it keeps its limit (``name`` says where the limit is a lower one)."""

    name: str
    value: float
    limit: float
    unit: str
    ok: bool


def at_most(name: str, value: float, limit: float, unit: str) -> Row:
    """A number that must not exceed its limit; a value that is not a number misses it."""
    return Row(name, float(value), limit, unit, bool(value <= limit))


def at_least(name: str, value: float, limit: float, unit: str) -> Row:
    """A number that must reach its limit."""
    return Row(f"{name} {AT_LEAST}", float(value), limit, unit, bool(value >= limit))


def table(rows: list[Row]) -> str:
    """The rows as a Markdown table."""
    head = ["| quantity | measured | limit | unit | |", "| --- | ---: | ---: | --- | --- |"]
    body = [
        f"| {row.name} | {row.value:.3g} | {row.limit:g} | {row.unit} | {'ok' if row.ok else '**missed**'} |"
        for row in rows
    ]
    return "\n".join(head + body)


def write_json(rows: list[Row], path: Path) -> None:
    """``accuracy.json``: a list of {name, value, limit, unit, ok}."""
    path.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")
