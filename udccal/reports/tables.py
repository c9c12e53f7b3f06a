"""Tables of numbers as text, the same for the terminal and the report: a value never has more digits than its sigma."""

from __future__ import annotations

import math
from dataclasses import dataclass

_MOST_DECIMALS = 9


@dataclass(frozen=True)
class Table:
    """Rows of text under named columns; ``right`` lists the columns of numbers, set flush right."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    right: frozenset[int] = frozenset()


def number(value: float, sigma: float | None = None) -> str:
    """Return a number to the second digit of its sigma, or with four significant digits without a sigma."""
    if not math.isfinite(value):
        return "not known"
    if sigma is None or not math.isfinite(sigma) or sigma <= 0:
        return f"{value:.4g}"
    return _fixed(value, _second_digit(sigma))


def spread(sigma: float | None) -> str:
    """Return a sigma with two digits, or a dash where there is none."""
    return "–" if sigma is None or not math.isfinite(sigma) or sigma <= 0 else _fixed(sigma, _second_digit(sigma))


def _second_digit(value: float) -> int:
    return 1 - math.floor(math.log10(value))


def _fixed(value: float, decimals: int) -> str:
    """The number without a power of ten, so that those of a column can be compared, unless it is huge or tiny."""
    if abs(value) >= 1e6 or decimals > _MOST_DECIMALS:
        digits = max(1, decimals + (math.floor(math.log10(abs(value))) if value else 0))
        return f"{value:.{min(digits, 8)}e}"
    return f"{round(value, decimals):.{max(decimals, 0)}f}"
