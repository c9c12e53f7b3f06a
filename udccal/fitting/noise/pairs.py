"""A pair of frames reduced to means and temporal variances per bin, in one pass over both."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from udccal.fitting.noise.differences import Frame, differences, unmixed, within_rows
from udccal.fitting.noise.moments import PairMoments, RowMoments
from udccal.fitting.noise.tiling import Tiling, tiling


@dataclass(frozen=True)
class _RowSums:
    """Sums over the columns of each group: of the difference, the sum less ``middle``, and of their squares."""

    difference: Float[np.ndarray, "rows groups_x"]
    square: Float[np.ndarray, "rows groups_x"]
    total: Float[np.ndarray, "rows groups_x"]
    total_square: Float[np.ndarray, "rows groups_x"]
    middle: int
    outliers: int


def reduce_pair(
    first: Frame, second: Frame, exposure_s: float, light: float | None = None, period: int = 2
) -> PairMoments:
    """Reduce a pair of frames; a common change of brightness and row noise drop out of the variance."""
    tiles = tiling(*first.shape, period)
    sums = _row_sums(first, second, tiles)
    total = tiles.down @ sums.total / tiles.counts
    spatial = tiles.down @ sums.total_square / tiles.counts - total**2
    columns = first.shape[1]
    within, row_means = within_rows(tiles, sums.difference, sums.square, columns)
    dof = np.maximum(tiles.counts * (1 - 1 / columns) - 1, 1.0)
    variance = 0.5 * unmixed(tiles, within / dof, columns)
    peak = max(int(first.max()), int(second.max()))
    sampling = float(np.average(variance, weights=tiles.counts)) / columns
    observed = 0.5 * float(np.var(row_means, ddof=1)) if len(row_means) > 1 else sampling
    return PairMoments(
        exposure_s=exposure_s,
        light=exposure_s if light is None else light,
        mean_DN=0.5 * (total + sums.middle).ravel(),
        variance_DN2=variance.ravel(),
        dof=dof.ravel(),
        samples=2 * tiles.counts.ravel(),
        spread_DN=np.sqrt(np.maximum(0.25 * spatial + 0.5 * variance, 0.0)).ravel(),
        rows=RowMoments(observed - sampling, sampling, len(row_means) - 1.0),
        shift_DN=(tiles.down @ sums.difference / tiles.counts).ravel(),
        frames=2,
        height=first.shape[0],
        peak_DN=peak,
        at_peak=float(np.count_nonzero(first == peak) + np.count_nonzero(second == peak)) / (2 * first.size),
        outliers=sums.outliers,
    )


def _row_sums(first: Frame, second: Frame, tiles: Tiling) -> _RowSums:
    difference, square, total, total_square = np.empty((4, first.shape[0], len(tiles.width)))
    # About a whole number near the mean: squares then stay small, and exact.
    middle = round(2 * float(first[:: max(first.shape[0] // 64, 1)].mean()))
    outliers = 0
    for strip in differences(first, second, tiles):
        rows = strip.rows
        both = cv2.addWeighted(first[rows], 1.0, second[rows], 1.0, -float(middle), dtype=cv2.CV_32F)
        difference[rows], square[rows] = tiles.across(strip.difference), tiles.across(strip.square)
        total[rows] = tiles.across(both)
        total_square[rows] = tiles.across(np.square(both, out=both))
        outliers += strip.outliers
    return _RowSums(difference, square, total, total_square, middle, outliers)
