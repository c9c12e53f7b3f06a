"""Frames of one scene as moments per bin, and their mean per pixel.

A bin is one site of the colour mosaic in one tile of the sensor. Frames come one by one: their differences from the
first frame are summed, and the squares of these, so that float32 loses no digits that matter.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from udccal.fitting.noise.data import Averaged, Codes, NoiseRules, dark_window
from udccal.fitting.noise.lines import Lines

Grid = Float[np.ndarray, "groups_y groups_x"]
Picture = Float32[np.ndarray, "rows columns"]
# Rows of the sensor's middle that are enough to compare neighbours.
MIDDLE_ROWS = 512
# Rows that agree by chance in a pair of frames: fewer are none.
_BY_CHANCE = 1e-9


def product_sum(first: Picture, second: Picture) -> float:
    """Sum of products, without a copy; sums by rows keep single precision exact enough."""
    return float(np.einsum("ij,ij->i", first, second).sum(dtype=np.float64))


@functools.lru_cache(maxsize=8)
def bins(
    rows: int, columns: int, period: int
) -> tuple[Float[np.ndarray, "groups_y rows"], Float32[np.ndarray, "columns groups_x"]]:
    """Ones where a row and a column belong to a group of bins; colour sites repeat every ``period`` samples."""
    # Tiles keep shading and a lamp's slow flicker out of the variance: at most 8 a side, each of 4096 samples a colour.
    tiles = int(np.clip(np.sqrt(rows * columns / period**2 / 4096), 1, 8))

    def groups(length: int) -> Float[np.ndarray, "length groups"]:
        # Whole mosaic cells per tile; the last tile has the remaining ones.
        tile = np.minimum(np.arange(length) // period // max(length // period // tiles, 1), tiles - 1)
        return np.eye(tiles * period)[tile * period + np.arange(length) % period]

    return groups(rows).T.copy(), groups(columns).astype(np.float32)


@final
@dataclass(frozen=True)
class Shared:
    """Correlation of a pixel's noise with that of the next of its colour along a row and along a column, and sigma."""

    along_row: float = 0.0
    along_column: float = 0.0
    sigma: float = np.inf

    @property
    def found(self) -> bool:
        """Whether they are no chance."""
        return max(abs(self.along_row), abs(self.along_column)) > 5.0 * self.sigma

    @property
    def gain_factor(self) -> float:
        """The true gain as a multiple of that found: what neighbours share is missing in the variance of each."""
        return max((1 + 2 * self.along_row) * (1 + 2 * self.along_column), 0.0)


def shared_noise(first: Codes, difference: Float32[np.ndarray, "rows columns"], period: int) -> Shared:
    """Of a frame and the next one's difference from it, less the rows' means; colours repeat after ``period`` samples.

    The rows in the middle are enough. Light that differs between the frames leaves a part of the picture, which a
    regression on their sum removes: the noise of sum and difference is independent. Correlation with the third next
    pixel is taken off: noise of columns has it as well.
    """
    rows, far = len(first), 3 * period
    middle = np.s_[max((rows - MIDDLE_ROWS) // 2, 0) : (rows + MIDDLE_ROWS) // 2]
    noise = difference[middle]
    total = cv2.addWeighted(first[middle], 2.0, noise, 1.0, 0.0, dtype=cv2.CV_32F)
    total -= total.mean(axis=1, keepdims=True)
    noise = noise - np.float32(product_sum(noise, total) / max(product_sum(total, total), 1e-9)) * total
    near, power = noise[:-far, :-far], max(product_sum(noise, noise) / noise.size, 1e-9)
    along_row = product_sum(near, noise[:-far, period : period - far] - noise[:-far, far:])
    along_column = product_sum(near, noise[period : period - far, :-far] - noise[far:, :-far])
    return Shared(along_row / power / near.size, along_column / power / near.size, float(np.sqrt(2.0 / near.size)))


@final
@dataclass(frozen=True)
class Moments:
    """Two or more frames of the same scene; arrays are per bin.

    ``light`` is the relative exposure to light, in any unit common to all levels (photons per pixel, or seconds).
    ``variance_DN2`` is the temporal variance of one frame, row noise and common changes of brightness removed, and
    ``dof`` its degrees of freedom; ``samples`` are frames times pixels; ``spread_DN`` is the standard deviation over
    these, spatial and temporal; ``shift_DN`` is the mean of each frame less that of all. ``rows`` and ``columns`` are
    what changes of their means from frame to frame; those of columns are without those of rows. ``at_peak`` is the
    fraction of the samples with the largest code, and ``codes`` the histogram of the first frame. ``outliers`` were
    hits, and left out; ``outlier_powers`` are the sums of the second, fourth and sixth powers of their differences
    from the first frame. ``shared`` is the noise that neighbours have in common in the first two frames. ``far`` is how
    many pixels lie outside the window of the dark histograms in both of these, and what they have of all squares.
    ``repeated``: some frames are copies of others. ``torn``: so many rows of the second frame are those of the first.
    """

    exposure_s: float
    light: float
    mean_DN: Float[np.ndarray, " bins"]
    variance_DN2: Float[np.ndarray, " bins"]
    dof: Float[np.ndarray, " bins"]
    samples: Float[np.ndarray, " bins"]
    spread_DN: Float[np.ndarray, " bins"]
    shift_DN: Float[np.ndarray, "frames bins"]
    rows: Lines
    columns: Lines
    peak_DN: int
    at_peak: Float[np.ndarray, " bins"]
    codes: Int[np.ndarray, " codes"]
    outliers: int
    outlier_powers: tuple[float, float, float]
    shared: Shared
    far: tuple[int, float]
    repeated: bool
    torn: int

    @property
    def frames(self) -> int:
        """How many."""
        return len(self.shift_DN)

    @property
    def height(self) -> int:
        """Rows of a frame."""
        return len(self.rows.power_DN2)

    @property
    def pixels(self) -> float:
        """Pixels of a frame."""
        return float(self.samples.sum()) / self.frames

    @property
    def level_DN(self) -> float:
        """Mean of all pixels and frames."""
        return float(np.average(self.mean_DN, weights=self.samples))

    @property
    def temporal_DN2(self) -> float:
        """Temporal variance of all bins."""
        return float(np.average(self.variance_DN2, weights=self.dof))

    @property
    def near_DN2(self) -> float:
        """Temporal variance of the pixels that are not ``far``: hot and dead pixels have noise of their own."""
        (pixels, squares), dof = self.far, float(self.dof.sum())
        return (self.temporal_DN2 * dof - squares) / max(dof - (self.frames - 1) * pixels, 1.0)

    @property
    def outlier_variance_DN2(self) -> float:
        """What the hits would add to the temporal variance."""
        return self.outlier_powers[0] / (2 * (self.frames - 1) * self.pixels)


def stacked(levels: tuple[Moments, ...], name: str) -> Float[np.ndarray, "levels bins"]:
    """The field ``name`` of every level and bin."""
    return np.stack([getattr(level, name) for level in levels])


def reduce_frames(
    frames: Iterable[Codes], exposure_s: float, light: float | None, period: int, rules: NoiseRules, dark_step: int = 0
) -> tuple[Averaged, Moments]:
    """Mean per pixel, and temporal moments per bin without common changes of brightness and row noise.

    ``dark_step`` is the converter's step, of dark frames: pixels beyond the window of the histograms are ``far``.
    """
    source = iter(frames)
    first, second, far = next(source), next(source), np.zeros(0, int)
    if dark_step:
        middle, reach = dark_window(first, dark_step)
        off = (np.abs(frame - float(dark_step * middle)) for frame in (first, second))
        far = np.flatnonzero(np.minimum(*off) > dark_step * reach)
    sums = _Sums(first, period, rules.hit_sigma, far)
    for frame in chain([second], source):
        sums.add(frame)
    return sums.reduced(exposure_s, exposure_s if light is None else light)


def _fingerprint(frame: Codes) -> int | None:
    """A number that tells noisy frames apart; None where most pixels have one code, so that frames may well agree."""
    sample = frame[:: max(len(frame) // 64, 1)]
    low, high = np.percentile(sample, [16.0, 84.0])
    return hash(sample.tobytes()) if high > low else None


def _torn_rows(first: Codes, second: Codes) -> int:
    """How many rows of two frames agree that chance makes differ; none where it does not make all of them differ."""
    same = (first == second).mean(axis=1)
    agree = np.flatnonzero(same == 1.0)
    if not agree.size or agree.size == len(first):
        return 0
    # Rows of one code, at an end of the range or of dead columns, may well agree.
    low, high = np.percentile(first[agree], [16.0, 84.0], axis=1)
    by_chance = len(first) * float(np.median(same[same < 1.0])) ** first.shape[1]
    return int(np.count_nonzero(high > low)) if by_chance < _BY_CHANCE else 0


class _Sums:
    """Sums over frames of what differs from the first one.

    ``seen`` has of every frame its rows' means, its columns' means and bins' sums less these, its ``far`` pixels, its
    largest code and how many samples of each bin have that.
    """

    def __init__(self, first: Codes, period: int, hit_sigma: float, far: Int[np.ndarray, " far"]) -> None:
        self._first, self._period, self._hit_sigma, self._far = first, period, hit_sigma, far
        self._down, self._right = bins(*first.shape, period)
        self._width = self._right.sum(axis=0, dtype=np.float64)
        self._counts = np.outer(self._down.sum(axis=1), self._width)
        self._total, self._squares = np.zeros(first.shape, np.float32), np.zeros_like(self._counts)
        self._outliers, self._powers = 0, np.zeros(3)
        self._shared: Shared | None = None
        self._torn = 0
        self._marks = [_fingerprint(first)]
        none = *(np.zeros(side) for side in first.shape), np.zeros_like(self._counts), np.zeros(far.size)
        self._seen = [(*none, *self._at_peak(first))]

    def add(self, frame: Codes) -> None:
        """Count one more frame."""
        if self._shared is None:
            self._torn = _torn_rows(self._first, frame)
        difference = self._without_hits(cv2.subtract(frame, self._first, dtype=cv2.CV_32F))
        rows = difference.mean(axis=1, dtype=np.float64)
        difference -= rows[:, None]
        self._shared = self._shared or shared_noise(self._first, difference, self._period)
        self._marks.append(_fingerprint(frame))
        far = difference.ravel()[self._far].astype(np.float64)
        columns = difference.mean(axis=0, dtype=np.float64)
        self._seen.append((rows, columns, self._binned(difference), far, *self._at_peak(frame)))
        self._total += difference
        self._squares += self._binned(cv2.multiply(difference, difference))

    def reduced(self, exposure_s: float, light: float) -> tuple[Averaged, Moments]:
        """The mean picture and the moments."""
        rows, across, left, far, peaks, at_peak = (np.stack(part) for part in zip(*self._seen, strict=True))
        (number, height), counts, marks = rows.shape, self._counts, [mark for mark in self._marks if mark]
        mean_DN = cv2.addWeighted(self._first, 1.0, self._total, 1.0 / number, 0.0, dtype=cv2.CV_32F)
        mean_DN += rows.mean(axis=0)[:, None]
        left -= left.mean(axis=0)
        rows -= rows.mean(axis=0)
        across -= across.mean(axis=0)
        columns, common = mean_DN.shape[1], np.square(left).sum(axis=0) / counts
        dof = np.maximum((number - 1) * (counts * (1 - 1 / columns) - 1), 1.0)
        squares = self._squares - self._binned(cv2.multiply(self._total, self._total, scale=1.0 / number)) - common
        # The rows' means were taken from all of a row: a quiet bin beside noisy ones gains their part of the mean's
        # variance, v' (1 - 1/n) = v (1 - 2/n) + row average / n.
        mixed = squares / dof
        variance = (mixed * (1 - 1 / columns) - (mixed @ self._width)[:, None] / columns**2) / (1 - 2 / columns)
        middle = float(np.median(self._first[:: max(height // 64, 1)]))
        about = cv2.subtract(mean_DN, middle)
        level = self._binned(about) / counts
        spatial = np.maximum(self._binned(cv2.multiply(about, about)) / counts - level**2, 0.0)
        usual = float(np.average(variance, weights=counts))
        moments = Moments(
            exposure_s=exposure_s,
            light=light,
            mean_DN=(level + middle).ravel(),
            variance_DN2=variance.ravel(),
            dof=dof.ravel(),
            samples=number * counts.ravel(),
            spread_DN=np.sqrt(spatial + np.maximum(variance, 0.0) * (1 - 1 / number)).ravel(),
            shift_DN=((left + (rows @ self._down.T)[..., None] * self._width) / counts).reshape(number, -1),
            rows=Lines.of(rows, usual / columns),
            columns=Lines.of(across, usual / height),
            peak_DN=int(peaks.max()),
            at_peak=(at_peak[peaks == peaks.max()].sum(axis=0) / (number * counts)).ravel(),
            codes=np.bincount(self._first.ravel()),
            outliers=self._outliers,
            outlier_powers=(float(self._powers[0]), float(self._powers[1]), float(self._powers[2])),
            shared=self._shared or Shared(),
            far=(self._far.size, float(np.var(far, axis=0).sum()) * number),
            repeated=len(set(marks)) < len(marks),
            torn=self._torn,
        )
        return Averaged(exposure_s, mean_DN, number), moments

    def _without_hits(self, difference: Picture) -> Picture:
        """The difference with its hits set to 0, which are counted."""
        square = cv2.multiply(difference, difference)
        # The usual difference is the median over some rows, which hits do not move; ten codes are never a hit.
        usual = np.median(square[:: max(len(square) // 128, 1)] @ self._right, axis=0) / self._width
        hits = square > max(self._hit_sigma**2 * float(usual.max()), 10.0**2)
        hits.ravel()[self._far] = False  # the shot noise of hot pixels is none
        if hits.any():
            large = square[hits].astype(np.float64)
            self._outliers += large.size
            self._powers += [large.sum(), (large**2).sum(), (large**3).sum()]
            difference[hits] = 0.0
        return difference

    def _binned(self, picture: Picture) -> Grid:
        return np.asarray(self._down @ (picture @ self._right))

    def _at_peak(self, frame: Codes) -> tuple[int, Grid]:
        return int(top := frame.max()), self._binned((frame == top).astype(np.float32))
