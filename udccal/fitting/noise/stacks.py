"""A stack of frames reduced one by one: the mean per pixel, and temporal moments about it per bin."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import cv2
import numpy as np
from jaxtyping import Float, UInt16

from udccal.fitting.noise.differences import differences, unmixed
from udccal.fitting.noise.moments import PairMoments, RowMoments, StackMoments
from udccal.fitting.noise.tiling import Tiling, tiling


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
        sums = np.empty_like(by_row[0])
        for strip in differences(load(), first, tiles):
            cv2.accumulate(strip.difference, total[strip.rows])
            cv2.accumulate(strip.square, squares[strip.rows])
            sums[strip.rows] = tiles.across(strip.difference)
            outliers += strip.outliers
        by_row.append(sums)
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
    variance = unmixed(tiles, (tiles.down @ within - np.square(left).sum(axis=0) / tiles.counts) / dof, columns)
    sampling = float(np.average(variance, weights=tiles.counts)) / columns
    row_dof = (frames - 1) * max(height - 1, 1)
    centred = rows - rows.mean(axis=1, keepdims=True)
    return variance, dof, RowMoments(float(np.sum(centred**2)) / row_dof - sampling, sampling, float(row_dof))
