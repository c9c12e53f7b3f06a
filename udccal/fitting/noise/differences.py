"""Differences of two frames, strip by strip, hits left out; and the variance that is left within rows and bins.

In float32 (exact: codes are integers), and in strips that stay in the processor's cache.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt16

from udccal.fitting.noise.tiling import Tiling

# A difference of codes beyond this many sigma (and this many codes) is a hit or a blinking pixel, not noise.
OUTLIER_SIGMA = 8.0
OUTLIER_LEAST_DN = 10.0
# Samples of a strip, and rows that tell the usual size of a difference.
_STRIP, _SAMPLED_ROWS = 1 << 17, 128

Frame = UInt16[np.ndarray, "rows columns"]


@dataclass(frozen=True)
class Strip:
    """Some rows: difference of the two frames and its square (outliers zero), and the number of outliers.

    The arrays are good until the next strip.
    """

    rows: slice
    difference: Float32[np.ndarray, "some columns"]
    square: Float32[np.ndarray, "some columns"]
    outliers: int


def differences(first: Frame, second: Frame, tiles: Tiling) -> Iterator[Strip]:
    """Strips of ``first - second``."""
    limit = np.float32(_limit(first, second, tiles))
    height = max(_STRIP // first.shape[1], 1)
    buffers = [np.empty((height, first.shape[1]), np.float32) for _ in range(2)]
    for top in range(0, first.shape[0], height):
        rows = slice(top, min(top + height, first.shape[0]))
        difference, square = (buffer[: rows.stop - top] for buffer in buffers)
        cv2.subtract(first[rows], second[rows], difference, dtype=cv2.CV_32F)
        cv2.multiply(difference, difference, square)
        outliers = 0
        if float(square.max()) > limit:
            wrong = square > limit
            difference[wrong] = 0.0
            square[wrong] = 0.0
            outliers = int(np.count_nonzero(wrong))
        yield Strip(rows, difference, square, outliers)


def _limit(first: Frame, second: Frame, tiles: Tiling) -> float:
    """Squared difference that no noise explains; the scale is the median over rows, which hits do not move."""
    every = max(first.shape[0] // _SAMPLED_ROWS, 1)
    difference = cv2.subtract(first[::every], second[::every], dtype=cv2.CV_32F)
    usual = np.median(tiles.across(np.square(difference)), axis=0) / tiles.width
    return max(OUTLIER_SIGMA**2 * float(usual.max()), OUTLIER_LEAST_DN**2)


def within_rows(
    tiles: Tiling, sums: Float[np.ndarray, "rows groups_x"], squares: Float[np.ndarray, "rows groups_x"], columns: int
) -> tuple[Float[np.ndarray, "groups_y groups_x"], Float[np.ndarray, " rows"]]:
    """Sums of squares about the means of rows and of bins; and the row means."""
    count = tiles.width
    rows = sums.sum(axis=1) / columns
    about_rows = squares - 2 * rows[:, None] * sums + rows[:, None] ** 2 * count
    left = tiles.down @ (sums - rows[:, None] * count)
    return tiles.down @ about_rows - left**2 / tiles.counts, rows


def unmixed(
    tiles: Tiling, variance: Float[np.ndarray, "groups_y groups_x"], columns: int
) -> Float[np.ndarray, "groups_y groups_x"]:
    """Variances of bins as if each row's mean had been taken from the bin's own kind of samples.

    It was taken from the whole row: a quiet bin beside noisy ones gains their share of the mean's variance,
    v' (1 - 1/n) = v (1 - 2/n) + row average / n.
    """
    average = (variance @ tiles.width / tiles.width.sum())[:, None]
    return (variance * (1 - 1 / columns) - average / columns) / (1 - 2 / columns)
