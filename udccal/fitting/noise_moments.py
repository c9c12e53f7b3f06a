"""Pairs and stacks of frames reduced to means and temporal variances per bin (CFA site x tile), row noise apart.

One pass over each pair, in float32 on differences of codes (exact: the codes are integers). Nothing of a pair is kept
but its bins, nothing of a stack but its mean.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt16

# Tiles keep shading and the slow flicker of a lamp out of the variance; each must still hold many samples.
_MOST_TILES = 8
_FEWEST_SAMPLES = 4096
# A difference of codes beyond this many sigma (and this many codes) is a hit or a blinking pixel, not noise.
OUTLIER_SIGMA = 8.0
OUTLIER_LEAST_DN = 10.0


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

    def bins(self, values: Float32[np.ndarray, "rows columns"]) -> Float[np.ndarray, "groups_y groups_x"]:
        """Sums over the samples of each bin."""
        return self.down @ self.across(values)


@dataclass(frozen=True)
class RowMoments:
    """Row noise of frames alike: sigma_row^2 (may be negative by chance), sampling variance included, and its rank."""

    variance_DN2: float
    sampling_DN2: float
    dof: float

    @property
    def sigma_DN2(self) -> float:
        """Standard deviation of ``variance_DN2``."""
        return (max(self.variance_DN2, 0.0) + self.sampling_DN2) * float(np.sqrt(2.0 / max(self.dof, 1.0)))


@dataclass(frozen=True)
class PairMoments:
    """Two frames of the same scene (or a stack of more).

    Attributes:
        exposure_s: of both frames.
        light: relative exposure to light, in any unit common to all levels (photons per pixel, or seconds).
        mean_DN: mean code per bin.
        variance_DN2: temporal variance of one frame per bin, row noise and common changes of brightness removed.
        dof: degrees of freedom of ``variance_DN2``.
        samples: frames times pixels of each bin.
        spread_DN: standard deviation over the samples of the bin, spatial and temporal.
        rows: row noise.
        shift_DN: mean of the first frame minus that of the second, per bin.
        frames: how many (2 for a pair).
        height: their rows.
        peak_DN: the largest code.
        at_peak: share of the samples with that code.
        outliers: samples whose two codes differ too much to be noise; left out.
    """

    exposure_s: float
    light: float
    mean_DN: Float[np.ndarray, " bins"]
    variance_DN2: Float[np.ndarray, " bins"]
    dof: Float[np.ndarray, " bins"]
    samples: Float[np.ndarray, " bins"]
    spread_DN: Float[np.ndarray, " bins"]
    rows: RowMoments
    shift_DN: Float[np.ndarray, " bins"]
    frames: int
    height: int
    peak_DN: int
    at_peak: float
    outliers: int


@dataclass(frozen=True)
class StackMoments:
    """Many frames of the same scene: their mean, and where the frames themselves were seen, temporal moments.

    ``temporal`` is None for an average that was made elsewhere: its variance would hold the lamp's flicker.
    """

    exposure_s: float
    mean_DN: Float32[np.ndarray, "rows columns"]
    frames: int
    temporal: PairMoments | None = None


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


def reduce_pair(
    first: UInt16[np.ndarray, "rows columns"],
    second: UInt16[np.ndarray, "rows columns"],
    exposure_s: float,
    light: float | None = None,
    period: int = 2,
) -> PairMoments:
    """Reduce a pair of frames; a common change of brightness and row noise drop out of the variance."""
    tiles = tiling(*first.shape, period)
    difference = cv2.subtract(first, second, dtype=cv2.CV_32F)
    square = cv2.multiply(difference, difference)
    outliers = _trim(difference, square, tiles)
    total = cv2.add(first, second, dtype=cv2.CV_32F)
    sums = tiles.bins(total)
    mean = 0.5 * sums / tiles.counts
    # Spatial spread about the middle: a constant taken off first keeps float32 squares exact enough.
    total -= np.float32(2 * mean.mean())
    offset = 2 * (mean - np.float32(2 * mean.mean()) / 2)
    spatial = tiles.bins(cv2.multiply(total, total)) / tiles.counts - offset**2
    columns = first.shape[1]
    by_row = tiles.across(difference)
    within, row_means = _within_rows(tiles, by_row, tiles.across(square), columns)
    shift = tiles.down @ by_row / tiles.counts
    dof = np.maximum(tiles.counts * (1 - 1 / columns) - 1, 1.0)
    variance = 0.5 * _unmixed(tiles, within / dof, columns)
    peak = max(int(first.max()), int(second.max()))
    sampling = float(np.average(variance, weights=tiles.counts)) / columns
    observed = 0.5 * float(np.var(row_means, ddof=1)) if len(row_means) > 1 else sampling
    return PairMoments(
        exposure_s=exposure_s,
        light=exposure_s if light is None else light,
        mean_DN=mean.ravel(),
        variance_DN2=variance.ravel(),
        dof=dof.ravel(),
        samples=2 * tiles.counts.ravel(),
        spread_DN=np.sqrt(np.maximum(0.25 * spatial + 0.5 * variance, 0.0)).ravel(),
        rows=RowMoments(observed - sampling, sampling, len(row_means) - 1.0),
        shift_DN=shift.ravel(),
        frames=2,
        height=first.shape[0],
        peak_DN=peak,
        at_peak=float(np.count_nonzero(first == peak) + np.count_nonzero(second == peak)) / (2 * first.size),
        outliers=outliers,
    )


def _trim(difference: np.ndarray, square: np.ndarray, tiles: Tiling) -> int:
    """Zero in place the samples that no noise explains; the scale is the median over rows, which hits do not move."""
    peak = float(square.max())
    if peak <= OUTLIER_LEAST_DN**2:
        return 0
    usual = np.median(tiles.across(square), axis=0) / tiles.width
    limit = max(OUTLIER_SIGMA**2 * float(usual.max()), OUTLIER_LEAST_DN**2)
    if peak <= limit:
        return 0
    wrong = square > limit
    difference[wrong] = 0.0
    square[wrong] = 0.0
    return int(wrong.sum())


def _within_rows(
    tiles: Tiling, sums: Float[np.ndarray, "rows groups_x"], squares: Float[np.ndarray, "rows groups_x"], columns: int
) -> tuple[Float[np.ndarray, "groups_y groups_x"], Float[np.ndarray, " rows"]]:
    """Sums of squares about the means of rows and of bins; and the row means."""
    count = tiles.width
    rows = sums.sum(axis=1) / columns
    about_rows = squares - 2 * rows[:, None] * sums + rows[:, None] ** 2 * count
    left = tiles.down @ (sums - rows[:, None] * count)
    return tiles.down @ about_rows - left**2 / tiles.counts, rows


def _unmixed(
    tiles: Tiling, variance: Float[np.ndarray, "groups_y groups_x"], columns: int
) -> Float[np.ndarray, "groups_y groups_x"]:
    """Variances of bins as if each row's mean had been taken from the bin's own kind of samples.

    It was taken from the whole row: a quiet bin beside noisy ones gains their share of the mean's variance,
    v' (1 - 1/n) = v (1 - 2/n) + row average / n.
    """
    average = (variance @ tiles.width / tiles.width.sum())[:, None]
    return (variance * (1 - 1 / columns) - average / columns) / (1 - 2 / columns)


def reduce_stack(
    frames: Iterable[Callable[[], UInt16[np.ndarray, "rows columns"]]],
    exposure_s: float,
    light: float | None = None,
    period: int = 2,
) -> StackMoments:
    """Reduce a stack frame by frame: mean per pixel, and temporal moments about it per bin.

    Differences to the first frame are summed, and their squares, so that float32 loses nothing; per frame its row
    means and the means of its bins are taken out, which removes row noise and flicker.
    """
    source = iter(frames)
    first = next(source)()
    tiles = tiling(*first.shape, period)
    columns = first.shape[1]
    count = tiles.width
    total, squares = (np.zeros(first.shape, np.float32) for _ in range(2))
    # The first frame differs from itself by nothing.
    by_row = [np.zeros((first.shape[0], len(count)))]
    outliers = 0
    for load in source:
        difference = cv2.subtract(load(), first, dtype=cv2.CV_32F)
        square = cv2.multiply(difference, difference)
        outliers += _trim(difference, square, tiles)
        cv2.accumulate(difference, total)
        cv2.accumulate(square, squares)
        by_row.append(tiles.across(difference))
    number = len(by_row)
    mean = first.astype(np.float32) + total / np.float32(number)
    if number < 2:
        return StackMoments(exposure_s, mean, number)
    spread = tiles.across(cv2.subtract(squares, cv2.multiply(total, total, scale=1.0 / number)))
    moments = _stack_moments(tiles, np.stack(by_row), spread, count, columns)
    variance, dof, rows = moments
    level = tiles.bins(mean) / tiles.counts
    return StackMoments(
        exposure_s,
        mean,
        number,
        PairMoments(
            exposure_s=exposure_s,
            light=exposure_s if light is None else light,
            mean_DN=level.ravel(),
            variance_DN2=variance.ravel(),
            dof=dof.ravel(),
            samples=number * tiles.counts.ravel(),
            spread_DN=np.sqrt(np.maximum(variance, 0.0) + _spatial(tiles, mean, level)).ravel(),
            rows=rows,
            shift_DN=np.zeros(variance.size),
            frames=number,
            height=first.shape[0],
            peak_DN=int(first.max()),
            at_peak=float(np.mean(first == first.max())),
            outliers=outliers,
        ),
    )


def _spatial(tiles: Tiling, mean: np.ndarray, level: np.ndarray) -> Float[np.ndarray, "groups_y groups_x"]:
    middle = np.float32(level.mean())
    about = mean - middle
    return np.maximum(tiles.bins(cv2.multiply(about, about)) / tiles.counts - (level - middle) ** 2, 0)


def _stack_moments(
    tiles: Tiling,
    by_row: Float[np.ndarray, "frames rows groups"],
    squares: Float[np.ndarray, "rows groups"],
    count: Float[np.ndarray, " groups"],
    columns: int,
) -> tuple[Float[np.ndarray, "groups_y groups_x"], Float[np.ndarray, "groups_y groups_x"], RowMoments]:
    frames, height = by_row.shape[:2]
    about = by_row - by_row.mean(axis=0)
    rows = about.sum(axis=2) / columns
    within = squares - 2 * np.einsum("kr,krm->rm", rows, about) + np.square(rows).sum(axis=0)[:, None] * count
    left = np.einsum("gr,krm->kgm", tiles.down, about - rows[:, :, None] * count)
    dof = np.maximum((frames - 1) * (tiles.counts * (1 - 1 / columns) - 1), 1.0)
    variance = _unmixed(tiles, (tiles.down @ within - np.square(left).sum(axis=0) / tiles.counts) / dof, columns)
    sampling = float(np.average(variance, weights=tiles.counts)) / columns
    row_dof = (frames - 1) * max(height - 1, 1)
    centred = rows - rows.mean(axis=1, keepdims=True)
    return variance, dof, RowMoments(float(np.sum(centred**2)) / row_dof - sampling, sampling, float(row_dof))
