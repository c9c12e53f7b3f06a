"""Tables of numbers as text, the same for the terminal and the report: a value never has more digits than its sigma."""

from __future__ import annotations

import math
from dataclasses import dataclass


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
    decimals = 1 - math.floor(math.log10(sigma))
    if abs(value) >= 1e6 or decimals > 6:
        digits = max(1, decimals + (math.floor(math.log10(abs(value))) if value else 0))
        return f"{value:.{min(digits, 8)}e}"
    return f"{value:.{max(decimals, 0)}f}"


def spread(sigma: float | None) -> str:
    """Return a sigma with two digits, or a dash where there is none."""
    return "–" if sigma is None or not math.isfinite(sigma) or sigma <= 0 else f"{sigma:.2g}"
