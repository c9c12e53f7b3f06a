"""Frames of one scene as moments per bin, and their mean per pixel.

A bin is one site of the colour mosaic in one tile of the sensor. Frames come one by one: their differences from the
first frame are summed, and the squares of these, so that float32 loses no digits that matter.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from udccal.fitting.noise.codes import dark_window
from udccal.fitting.noise.data import Averaged, Codes, NoiseRules
from udccal.fitting.noise.neighbours import Shared, shared_noise

Grid = Float[np.ndarray, "groups_y groups_x"]
Picture = Float32[np.ndarray, "rows columns"]


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
class Moments:
    """Two or more frames of the same scene; arrays are per bin.

    ``light`` is the relative exposure to light, in any unit common to all levels (photons per pixel, or seconds).
    ``variance_DN2`` is the temporal variance of one frame, row noise and common changes of brightness removed, and
    ``dof`` its degrees of freedom; ``samples`` are frames times pixels; ``spread_DN`` is the standard deviation over
    these, spatial and temporal; ``shift_DN`` is the mean of each frame less that of all. ``rows_DN2`` is the variance
    of the rows' means, and ``sampling_DN2`` the part of it that is sampling; frames have ``height`` rows. ``at_peak``
    is the fraction of the samples with the largest code, and ``codes`` the histogram of the first frame. ``outliers``
    were hits, and left out; ``outlier_powers`` are the sums of the second and fourth powers of their differences from
    the first frame. ``shared`` is the noise that neighbours have in common in the first two frames. ``far`` is how many
    pixels lie outside the window of the dark histograms in both of these, and what they have of all frames' squares.
    ``repeated``: some frames are copies of others.
    """

    exposure_s: float
    light: float
    mean_DN: Float[np.ndarray, " bins"]
    variance_DN2: Float[np.ndarray, " bins"]
    dof: Float[np.ndarray, " bins"]
    samples: Float[np.ndarray, " bins"]
    spread_DN: Float[np.ndarray, " bins"]
    shift_DN: Float[np.ndarray, "frames bins"]
    rows_DN2: float
    sampling_DN2: float
    height: int
    peak_DN: int
    at_peak: Float[np.ndarray, " bins"]
    codes: Int[np.ndarray, " codes"]
    outliers: int
    outlier_powers: tuple[float, float]
    shared: Shared
    far: tuple[int, float] = (0, 0.0)
    repeated: bool = False

    @property
    def frames(self) -> int:
        """How many."""
        return len(self.shift_DN)

    @property
    def pixels(self) -> float:
        """Pixels of a frame."""
        return float(self.samples.sum()) / self.frames

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
    frames: Iterable[Codes],
    exposure_s: float,
    light: float | None,
    period: int,
    rules: NoiseRules,
    dark_step: int | None = None,
) -> tuple[Averaged, Moments]:
    """Mean per pixel, and temporal moments per bin without common changes of brightness and row noise.

    ``dark_step`` is the converter's step, of dark frames: pixels beyond the window of the histograms are ``far``.
    """
    source = iter(frames)
    sums = _Sums(next(source), period, rules)
    for number, frame in enumerate(source):
        if dark_step and not number:
            sums.set_apart(frame, *dark_window(sums.first, dark_step), dark_step)
        sums.add(frame)
    rows, mean_DN = sums.mean()
    return Averaged(exposure_s, mean_DN, len(rows)), sums.moments(exposure_s, light, rows, mean_DN)


class _Sums:
    """Sums over frames of what differs from the first one.

    Of every frame, ``by_row`` has its rows' means, ``by_bin`` its bins' sums less these, ``peaks`` its largest code and
    how many samples of each bin have it. Pixels that were ``set_apart`` have their differences in ``apart``.
    """

    def __init__(self, first: Codes, period: int, rules: NoiseRules) -> None:
        self.first, self._period, self._rules = first, period, rules
        self._down, self._right = bins(*first.shape, period)
        self._width = self._right.sum(axis=0, dtype=np.float64)
        self._counts = np.outer(self._down.sum(axis=1), self._width)
        self._total, self._squares = np.zeros(first.shape, np.float32), np.zeros_like(self._counts)
        self._outliers, self._powers = 0, np.zeros(2)
        self._shared: Shared | None = None
        self._by_row, self._by_bin = [np.zeros(len(first))], [np.zeros_like(self._counts)]
        self._peaks = [self._at_peak(first)]
        self._far, self._apart = np.zeros(0, int), [np.zeros(0)]

    def set_apart(self, second: Codes, middle: int, reach: int, step: int) -> None:
        """Pixels that lie beyond a window, in steps of codes, in the first frame and in this one."""
        off = (np.abs(frame - float(step * middle)) for frame in (self.first, second))
        self._far = np.flatnonzero(np.minimum(*off) > step * reach)
        self._apart = [np.zeros(self._far.size)]

    def add(self, frame: Codes) -> None:
        """Count one more frame."""
        difference = self._without_hits(cv2.subtract(frame, self.first, dtype=cv2.CV_32F))
        self._by_row.append(difference.mean(axis=1, dtype=np.float64))
        difference -= self._by_row[-1][:, None]
        self._shared = self._shared or shared_noise(self.first, difference, self._period)
        self._apart.append(difference.ravel()[self._far].astype(np.float64))
        self._total += difference
        self._by_bin.append(self._binned(difference))
        self._squares += self._binned(cv2.multiply(difference, difference))
        self._peaks.append(self._at_peak(frame))

    def mean(self) -> tuple[Float[np.ndarray, "frames rows"], Picture]:
        """The rows' means of every frame, less those of the first, and the mean picture."""
        rows = np.stack(self._by_row)
        mean = cv2.addWeighted(self.first, 1.0, self._total, 1.0 / len(rows), 0.0, dtype=cv2.CV_32F)
        mean += rows.mean(axis=0)[:, None]
        return rows, mean

    def moments(
        self, exposure_s: float, light: float | None, rows: Float[np.ndarray, "frames rows"], mean_DN: Picture
    ) -> Moments:
        """The moments; ``rows`` and ``mean_DN`` as from ``mean``."""
        (number, height), counts, left = rows.shape, self._counts, np.stack(self._by_bin)
        left -= left.mean(axis=0)
        variance, dof = self._variance(left)
        middle = float(np.median(self.first[:: max(height // 64, 1)]))
        about = cv2.subtract(mean_DN, middle)
        level = self._binned(about) / counts
        spatial = np.maximum(self._binned(cv2.multiply(about, about)) / counts - level**2, 0.0)
        peak, rows = max(code for code, _ in self._peaks), rows - rows.mean(axis=0)
        shift = (left + (rows @ self._down.T)[..., None] * self._width) / counts
        of_rows = float(np.square(rows - rows.mean(axis=1, keepdims=True)).sum())
        return Moments(
            exposure_s=exposure_s,
            light=exposure_s if light is None else light,
            mean_DN=(level + middle).ravel(),
            variance_DN2=variance.ravel(),
            dof=dof.ravel(),
            samples=number * counts.ravel(),
            spread_DN=np.sqrt(spatial + np.maximum(variance, 0.0) * (1 - 1 / number)).ravel(),
            shift_DN=shift.reshape(number, -1),
            rows_DN2=of_rows / ((number - 1) * max(height - 1, 1)),
            sampling_DN2=float(np.average(variance, weights=counts)) / mean_DN.shape[1],
            height=height,
            peak_DN=peak,
            at_peak=(sum(count for code, count in self._peaks if code == peak) / (number * counts)).ravel(),
            codes=np.bincount(self.first.ravel()),
            outliers=self._outliers,
            outlier_powers=(float(self._powers[0]), float(self._powers[1])),
            shared=self._shared or Shared(),
            far=(self._far.size, float(np.var(self._apart, axis=0).sum()) * number),
        )

    def _without_hits(self, difference: Picture) -> Picture:
        """The difference with its hits set to 0, which are counted."""
        square, rules = cv2.multiply(difference, difference), self._rules
        # The usual difference is the median over some rows, which hits do not move; ten codes are never a hit.
        usual = np.median(square[:: max(len(square) // 128, 1)] @ self._right, axis=0) / self._width
        hits = square > max(rules.hit_sigma**2 * float(usual.max()), 10.0**2)
        hits.ravel()[self._far] = False  # the shot noise of hot pixels is none
        if hits.any():
            large = square[hits].astype(np.float64)
            self._outliers += large.size
            self._powers += [large.sum(), np.square(large).sum()]
            difference[hits] = 0.0
        return difference

    def _variance(self, left: Float[np.ndarray, "frames groups_y groups_x"]) -> tuple[Grid, Grid]:
        """Temporal variance of one frame, and its degrees of freedom; ``left`` are the bins' sums less their mean."""
        number, columns = len(left), self.first.shape[1]
        dof = np.maximum((number - 1) * (self._counts * (1 - 1 / columns) - 1), 1.0)
        squares = self._squares - self._binned(cv2.multiply(self._total, self._total, scale=1.0 / number))
        squares -= np.square(left).sum(axis=0) / self._counts
        # The rows' means were taken from all of a row: a quiet bin beside noisy ones gains their part of the mean's
        # variance, v' (1 - 1/n) = v (1 - 2/n) + row average / n.
        mixed = squares / dof
        variance = (mixed * (1 - 1 / columns) - (mixed @ self._width)[:, None] / columns**2) / (1 - 2 / columns)
        return variance, dof

    def _binned(self, picture: Picture) -> Grid:
        return np.asarray(self._down @ (picture @ self._right))

    def _at_peak(self, frame: Codes) -> tuple[int, Grid]:
        return int(top := frame.max()), self._binned((frame == top).astype(np.float32))
