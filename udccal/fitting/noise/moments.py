"""Frames of one scene reduced to moments per bin: mean and temporal variance, row noise apart, hits left out.

A bin is one site of the colour mosaic in one tile of the sensor. Frames come one by one; their differences to the first
are summed, and the squares of these, so that float32 loses nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt16

from udccal.fitting.noise.rules import NoiseRules

Codes = UInt16[np.ndarray, "rows columns"]
Grid = Float[np.ndarray, "groups_y groups_x"]
# Samples of a strip, which stays in the processor's cache; and rows that tell the usual size of a difference.
_STRIP, _SAMPLED_ROWS = 1 << 17, 128


@final
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
    counts: Grid

    def across(self, values: Float32[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows groups_x"]:
        """Sums over the columns of each group."""
        sums = np.empty((values.shape[0], len(self.width)))
        for phase, starts in enumerate(self.starts):
            sums[:, phase :: self.period] = np.add.reduceat(values[:, phase :: self.period], starts, axis=1)
        return sums

    def means(self, values: Float32[np.ndarray, "rows columns"]) -> Grid:
        """Means over the samples of each bin."""
        return self.down @ self.across(values) / self.counts


@functools.lru_cache(maxsize=8)
def tiling(rows: int, columns: int, period: int, rules: NoiseRules) -> Tiling:
    """Tiles of a sensor whose colour sites repeat every ``period`` samples (1: monochrome)."""
    tiles = int(np.clip(np.sqrt(rows * columns / period**2 / rules.tile_samples), 1, rules.tiles))

    def groups(length: int) -> Int[np.ndarray, " length"]:
        """Whole mosaic cells per tile; what is left over goes to the last one."""
        tile = np.minimum(np.arange(length) // period // max(length // period // tiles, 1), tiles - 1)
        return tile * period + np.arange(length) % period

    starts = np.tile(np.arange(tiles) * max(columns // period // tiles, 1), (period, 1))
    width = np.bincount(groups(columns), minlength=tiles * period).astype(np.float64)
    down = np.eye(tiles * period)[groups(rows)].T.copy()
    return Tiling(period, starts, width, down, np.outer(down.sum(axis=1), width))


@final
@dataclass(frozen=True)
class RowMoments:
    """Row noise of frames alike: sigma_row^2 (may be negative by chance), sampling variance beside it, and its rank."""

    variance_DN2: float
    sampling_DN2: float
    dof: float


@final
@dataclass(frozen=True)
class Moments:
    """Two or more frames of the same scene.

    Attributes:
        exposure_s: of the frames.
        light: relative exposure to light, in any unit common to all levels (photons per pixel, or seconds).
        mean_DN: mean code per bin.
        variance_DN2: temporal variance of one frame per bin, row noise and common changes of brightness removed.
        dof: degrees of freedom of ``variance_DN2``.
        samples: frames times pixels of each bin.
        spread_DN: standard deviation over the samples of the bin, spatial and temporal.
        shift_DN: mean of each frame in each bin, less that of all frames.
        rows: row noise.
        height: rows of a frame.
        peak_DN: the largest code.
        at_peak: share of the samples with that code.
        outliers: samples that differ too much from the first frame's to be noise; left out.
    """

    exposure_s: float
    light: float
    mean_DN: Float[np.ndarray, " bins"]
    variance_DN2: Float[np.ndarray, " bins"]
    dof: Float[np.ndarray, " bins"]
    samples: Float[np.ndarray, " bins"]
    spread_DN: Float[np.ndarray, " bins"]
    shift_DN: Float[np.ndarray, "frames bins"]
    rows: RowMoments
    height: int
    peak_DN: int
    at_peak: float
    outliers: int

    @property
    def frames(self) -> int:
        """How many."""
        return len(self.shift_DN)


@final
@dataclass(frozen=True)
class Averaged:
    """Mean of frames alike and, where the frames themselves were seen, their moments.

    ``temporal`` is None for an average that was made elsewhere: its variance would hold the lamp's flicker.
    """

    exposure_s: float
    mean_DN: Float32[np.ndarray, "rows columns"]
    frames: int
    temporal: Moments | None = None


def reduce_frames(
    frames: Iterable[Callable[[], Codes]], exposure_s: float, light: float | None, period: int, rules: NoiseRules
) -> Averaged:
    """Mean per pixel, and temporal moments about it per bin: common changes of brightness and row noise taken out.

    Args:
        frames: functions that load one frame each, all of one shape; at least two.
        exposure_s: of all frames, in seconds.
        light: relative exposure to light; the exposure time where not known.
        period: colour sites repeat after so many samples (1: monochrome).
        rules: size of the tiles, and what is a hit.
    """
    source = iter(frames)
    first = next(source)()
    tiles = tiling(*first.shape, period, rules)
    total, squares = np.zeros((2, *first.shape), np.float32)
    # The first frame differs from itself by nothing.
    by_row, peaks, outliers = [np.zeros((first.shape[0], len(tiles.width)))], [_peak(first)], 0
    for load in source:
        frame = load()
        by_row.append(np.empty_like(by_row[0]))
        peaks.append(_peak(frame))
        outliers += _add_difference(frame, first, tiles, rules, total, squares, by_row[-1])
    number, middle = len(by_row), np.float32(np.median(first[:: max(len(first) // 64, 1)]))
    mean = cv2.addWeighted(first, 1.0, total, 1.0 / number, 0.0, dtype=cv2.CV_32F)
    within = tiles.across(cv2.subtract(squares, cv2.multiply(total, total, scale=1.0 / number)))
    variance, dof, shift, rows = _temporal(tiles, np.stack(by_row), within, first.shape[1])
    about = cv2.subtract(mean, float(middle))
    level = tiles.means(about)
    spatial = np.maximum(tiles.means(cv2.multiply(about, about)) - level**2, 0.0)
    peak = max(code for code, _ in peaks)
    moments = Moments(
        exposure_s=exposure_s,
        light=exposure_s if light is None else light,
        mean_DN=(level + middle).ravel(),
        variance_DN2=variance.ravel(),
        dof=dof.ravel(),
        samples=number * tiles.counts.ravel(),
        spread_DN=np.sqrt(spatial + np.maximum(variance, 0.0) * (1 - 1 / number)).ravel(),
        shift_DN=shift.reshape(number, -1),
        rows=rows,
        height=first.shape[0],
        peak_DN=peak,
        at_peak=sum(count for code, count in peaks if code == peak) / (number * first.size),
        outliers=outliers,
    )
    return Averaged(exposure_s, mean, number, moments)


def _peak(frame: Codes) -> tuple[int, int]:
    """The largest code, and how many samples have it."""
    top = frame.max()
    return int(top), int(np.count_nonzero(frame == top))


def _add_difference(
    frame: Codes,
    first: Codes,
    tiles: Tiling,
    rules: NoiseRules,
    total: Float32[np.ndarray, "rows columns"],
    squares: Float32[np.ndarray, "rows columns"],
    by_row: Float[np.ndarray, "rows groups_x"],
) -> int:
    """Adds ``frame - first`` and its square, and writes its sums by row; gives the number of hits left out."""
    sample = np.s_[:: max(len(first) // _SAMPLED_ROWS, 1)]
    difference = cv2.subtract(frame[sample], first[sample], dtype=cv2.CV_32F)
    # The scale is the median over rows, which hits do not move.
    usual = np.median(tiles.across(np.square(difference)), axis=0) / tiles.width
    limit, outliers = np.float32(max(rules.hit_sigma**2 * float(usual.max()), rules.hit_DN**2)), 0
    height = max(_STRIP // first.shape[1], 1)
    for top in range(0, len(first), height):
        rows = np.s_[top : top + height]
        difference = cv2.subtract(frame[rows], first[rows], dtype=cv2.CV_32F)
        square = cv2.multiply(difference, difference)
        if float(square.max()) > limit:
            wrong = square > limit
            difference[wrong] = square[wrong] = 0.0
            outliers += int(np.count_nonzero(wrong))
        cv2.accumulate(difference, total[rows])
        cv2.accumulate(square, squares[rows])
        by_row[rows] = tiles.across(difference)
    return outliers


def _temporal(
    tiles: Tiling,
    by_row: Float[np.ndarray, "frames rows groups_x"],
    squares: Float[np.ndarray, "rows groups_x"],
    columns: int,
) -> tuple[Grid, Grid, Float[np.ndarray, "frames groups_y groups_x"], RowMoments]:
    """Variances of bins, their degrees of freedom, the frames' shifts, and row noise."""
    frames, height = by_row.shape[:2]
    about = by_row - by_row.mean(axis=0)
    rows = about.sum(axis=2) / columns
    within = squares - 2 * np.einsum("kr,krm->rm", rows, about) + np.square(rows).sum(axis=0)[:, None] * tiles.width
    left = np.einsum("gr,krm->kgm", tiles.down, about - rows[:, :, None] * tiles.width)
    dof = np.maximum((frames - 1) * (tiles.counts * (1 - 1 / columns) - 1), 1.0)
    mixed = (tiles.down @ within - np.square(left).sum(axis=0) / tiles.counts) / dof
    # The rows' means were taken from all of a row: a quiet bin beside noisy ones gains their share of the mean's
    # variance, v' (1 - 1/n) = v (1 - 2/n) + row average / n.
    average = (mixed @ tiles.width / tiles.width.sum())[:, None]
    variance = (mixed * (1 - 1 / columns) - average / columns) / (1 - 2 / columns)
    sampling = float(np.average(variance, weights=tiles.counts)) / columns
    row_dof = (frames - 1) * max(height - 1, 1)
    observed = float(np.sum((rows - rows.mean(axis=1, keepdims=True)) ** 2)) / row_dof
    shift = np.einsum("gr,krm->kgm", tiles.down, about) / tiles.counts
    return variance, dof, shift, RowMoments(observed - sampling, sampling, float(row_dof))
