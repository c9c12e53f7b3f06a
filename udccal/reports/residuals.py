"""Computes the residuals of a fit as a map over the sensor and as a histogram."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from udccal.result import ResidualSample

# A cell of the map needs several residuals for a meaningful mean; this many on average.
_WANTED = 12
_MOST_CELLS = 32
_REACH, _BINS = 5.0, 50


@dataclass(frozen=True)
class ResidualMap:
    """Mean residual of each cell of the sensor in units of its own sigma (NaN where a cell holds none); row 0 on top.

    Where the model describes the data these are normal numbers: 95 of 100 cells lie within 2.
    """

    mean_sigma: Float[np.ndarray, "down across"]


@dataclass(frozen=True)
class ResidualHistogram:
    """Residuals in units of sigma: bin edges, counts, their mean and standard deviation, and how many lie outside."""

    edges: Float[np.ndarray, " bins_plus_1"]
    counts: Int[np.ndarray, " bins"]
    mean: float
    std: float
    outside: int


def residual_map(sample: ResidualSample, columns: int, rows: int) -> ResidualMap:
    """Average residuals over cells of a sensor of ``rows`` x ``columns``."""
    cells = max(len(sample.z) / _WANTED, 1.0)
    across = int(np.clip(np.sqrt(cells * columns / rows), 1, _MOST_CELLS))
    down = int(np.clip(np.sqrt(cells * rows / columns), 1, _MOST_CELLS))
    place = (sample.positions_px + 0.5) / [columns, rows] * [across, down]
    x, y = np.clip(place.astype(int), 0, [across - 1, down - 1]).T
    count = np.bincount(y * across + x, minlength=down * across)
    total = np.bincount(y * across + x, weights=sample.z, minlength=down * across)
    mean = np.where(count > 0, total / np.sqrt(np.maximum(count, 1)), np.nan)
    return ResidualMap(mean.reshape(down, across))


def residual_histogram(sample: ResidualSample) -> ResidualHistogram:
    """Count residuals from -5 to 5 sigma."""
    counts, edges = np.histogram(sample.z, bins=_BINS, range=(-_REACH, _REACH))
    inside = int(counts.sum())
    return ResidualHistogram(edges, counts, float(sample.z.mean()), float(sample.z.std()), len(sample.z) - inside)
