"""Percentiles of durations in memory that does not grow."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, final

import numpy as np

# Bins of equal ratio, 1 % wide, from 10 us to 100 s; what lies outside counts in the first or last one.
_LEAST_S: Final = 1e-5
_RATIO: Final = 1.01
_BINS: Final = math.ceil(math.log(1e7) / math.log(_RATIO))


@final
@dataclass(frozen=True)
class Spread:
    """Percentiles in ms; None where nothing was measured."""

    p50: float | None
    p95: float | None
    p99: float | None


@final
class Durations:
    """A histogram of durations."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS + 1, np.int64)

    def add(self, seconds: float) -> None:
        """Count one duration."""
        place = math.log(max(seconds, _LEAST_S) / _LEAST_S) / math.log(_RATIO)
        self._counts[min(math.ceil(place), _BINS)] += 1

    def spread(self) -> Spread:
        """Return the percentiles, at most 1 % too large."""
        return Spread(self._percentile_ms(50), self._percentile_ms(95), self._percentile_ms(99))

    def _percentile_ms(self, percent: int) -> float | None:
        total = int(self._counts.sum())
        if total == 0:
            return None
        place = int(np.searchsorted(np.cumsum(self._counts), math.ceil(total * percent / 100)))
        return 1e3 * _LEAST_S * _RATIO**place
