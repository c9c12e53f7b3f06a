"""Bins of a sensor: the sites of its colour mosaic times tiles, and sums over them."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

# Tiles keep shading and the slow flicker of a lamp out of the variance; each must still hold many samples.
_MOST_TILES = 8
_FEWEST_SAMPLES = 4096


@dataclass(frozen=True)
class Tiling:
    """Sites and tiles of a sensor; groups are (tile, phase of the mosaic), the phase running fastest.

    Attributes:
        period: of the mosaic.
        starts: per phase, where its tiles begin among the columns of that phase.
        width: columns per group.
        down: which rows belong to which group.
        counts: samples per bin.
    """

    period: int
    starts: Int[np.ndarray, "period tiles"]
    width: Float[np.ndarray, " groups_x"]
    down: Float[np.ndarray, "groups_y rows"]
    counts: Float[np.ndarray, "groups_y groups_x"]

    def across(self, values: Float32[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows groups_x"]:
        """Sums over the columns of each group."""
        sums = np.empty((values.shape[0], len(self.width)))
        for phase, starts in enumerate(self.starts):
            sums[:, phase :: self.period] = np.add.reduceat(values[:, phase :: self.period], starts, axis=1)
        return sums

    @property
    def centres_px(self) -> Float[np.ndarray, "bins 2"]:
        """Column and row of the middle of each bin, in the order of the bins."""
        rows = self.down @ np.arange(self.down.shape[1]) / self.down.sum(axis=1)
        # Groups of one tile share its columns; the phases are a sample or so apart.
        ends = np.cumsum(self.width.reshape(-1, self.period).sum(axis=1))
        tiles = np.repeat(ends - 0.5 * np.diff(ends, prepend=0.0), self.period)
        columns = tiles + np.tile(np.arange(self.period), len(ends)) - 0.5 * self.period
        across, down = np.meshgrid(columns, rows)
        return np.column_stack([across.ravel(), down.ravel()])

    def bins(self, values: Float32[np.ndarray, "rows columns"]) -> Float[np.ndarray, "groups_y groups_x"]:
        """Sums over the samples of each bin."""
        return self.down @ self.across(values)


@functools.lru_cache(maxsize=8)
def tiling(rows: int, columns: int, period: int) -> Tiling:
    """Tiles of a sensor whose colour sites repeat every ``period`` samples (1: monochrome)."""
    samples = rows * columns / period**2
    tiles = int(np.clip(np.sqrt(samples / _FEWEST_SAMPLES), 1, _MOST_TILES))
    # Whole mosaic cells per tile; what is left over goes to the last one.
    cell = max(columns // period // tiles, 1)
    starts = np.tile(np.arange(tiles) * cell, (period, 1))
    of_column = np.minimum(np.arange(columns) // period // cell, tiles - 1) * period + np.arange(columns) % period
    width = np.bincount(of_column, minlength=tiles * period).astype(np.float64)
    tall = max(rows // period // tiles, 1)
    of_row = np.minimum(np.arange(rows) // period // tall, tiles - 1) * period + np.arange(rows) % period
    down = np.eye(tiles * period)[of_row].T.copy()
    return Tiling(period, starts, width, down, np.outer(down.sum(axis=1), width))
