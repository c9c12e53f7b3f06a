"""A mosaic in overlapping tiles, each small enough for one kernel and one brightness, and their pictures joined again.

A tile's border is tapered before its transform, so that opposite edges meet at zero; only what the taper leaves whole
is used. There, neighbouring tiles are blended.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float32, Int

from udccal.errors import RestorationError

TAPER_PX, BLEND_PX = 24, 16


@final
@dataclass(frozen=True)
class TileLayout:
    """Tiles that cover some rows of a frame.

    Attributes:
        rows, columns: size of a tile, multiples of the colour pattern's cell.
        first_row, last_row: rows of the frame that are covered, the last one excluded. frame_rows: the frame's rows.
        frame_columns: the frame's columns; all are covered.
        cell_rows, cell_columns: the colour pattern's cell; every tile starts at the beginning of one.
    """

    rows: int
    columns: int
    first_row: int
    last_row: int
    frame_rows: int
    frame_columns: int
    cell_rows: int
    cell_columns: int

    @functools.cached_property
    def tops(self) -> tuple[int, ...]:
        """First row of each row of tiles; it may lie outside the frame."""
        return _starts(self.first_row, self.last_row, self.rows, self.cell_rows)

    @functools.cached_property
    def lefts(self) -> tuple[int, ...]:
        """First column of each column of tiles; it may lie outside the frame."""
        return _starts(0, self.frame_columns, self.columns, self.cell_columns)

    @property
    def count(self) -> int:
        """Number of tiles, which are numbered row by row."""
        return len(self.tops) * len(self.lefts)

    @property
    def centres_px(self) -> Float32[np.ndarray, "tiles 2"]:
        """(x, y) of the tiles' centres on the sensor."""
        y, x = (
            np.array(starts) + (size - 1) / 2 for starts, size in ((self.tops, self.rows), (self.lefts, self.columns))
        )
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float32)

    @functools.cached_property
    def taper(self) -> Float32[np.ndarray, "rows columns"]:
        """Weights of a tile's samples before the transform."""
        return _ramped(self.rows, 0, TAPER_PX)[:, None] * _ramped(self.columns, 0, TAPER_PX)

    def cut(self, mosaic: Float32[np.ndarray, "frame_rows frame_columns"]) -> Float32[np.ndarray, "tiles rows columns"]:
        """Return the tiles of a mosaic, which is mirrored at its borders cell by cell."""
        rows = _mirrored(self.tops, self.rows, self.frame_rows, self.cell_rows)
        columns = _mirrored(self.lefts, self.columns, self.frame_columns, self.cell_columns)
        low = min(int(rows.min()), self.frame_rows - 1)
        strip = mosaic[low : int(rows.max()) + 1]
        tiles = np.empty((self.count, self.rows, self.columns), dtype=np.float32)
        for tile, (down, across) in zip(tiles, itertools.product(rows - low, columns), strict=True):
            np.take(strip[_run(down)], across, axis=1, out=tile, mode="clip")
        return tiles

    def join(
        self, pictures: Float32[np.ndarray, "tiles channels rows columns"]
    ) -> Float32[np.ndarray, "frame_rows frame_columns channels"]:
        """Blend the tiles' pictures into one of the frame; rows that no tile covers are 0."""
        frame = np.zeros((pictures.shape[1], self.frame_rows, self.frame_columns), dtype=np.float32)
        down, across = _ramped(self.rows, TAPER_PX, BLEND_PX), _ramped(self.columns, TAPER_PX, BLEND_PX)
        covered_y = _covered(down, self.tops, self.frame_rows)
        covered_x = _covered(across, self.lefts, self.frame_columns)
        for picture, (top, left) in zip(pictures, itertools.product(self.tops, self.lefts), strict=True):
            y, x = _inside(top, self.rows, self.frame_rows), _inside(left, self.columns, self.frame_columns)
            at = slice(top + y.start, top + y.stop), slice(left + x.start, left + x.stop)
            weight = (down[y] / covered_y[at[0]])[:, None] * (across[x] / covered_x[at[1]])
            frame[:, *at] += picture[:, y, x] * weight
        return np.ascontiguousarray(np.moveaxis(frame, 0, -1))

    def spread(
        self, values: Float32[np.ndarray, "tiles k"]
    ) -> Iterator[Float32[np.ndarray, "tiles_down tiles_across"]]:
        """Return each of the tiles' ``k`` values as a small picture with one pixel per tile."""
        for value in values.T:
            yield value.reshape(len(self.tops), len(self.lefts))


def layout_for(
    frame_rows: int, frame_columns: int, cell: tuple[int, int], size: tuple[int, int], rows: tuple[int, int]
) -> TileLayout:
    """Return the tiles that cover the ``rows`` (first, past the last) of a frame.

    Args:
        frame_rows: rows of the frame. frame_columns: columns of the frame.
        cell: (rows, columns) of the colour pattern.
        size: (rows, columns) of a tile, rounded up to whole cells.
        rows: first row to be covered, and the row after the last one.

    Raises:
        RestorationError: when a tile is too small to have a part that is neither tapered nor blended.
    """
    least = 2 * (TAPER_PX + BLEND_PX)
    if min(size) < least:
        raise RestorationError(
            f"Expected tiles of at least {least} x {least} px, found {size[1]} x {size[0]}. Give larger ones."
        )
    height, width = (-(-most // unit) * unit for most, unit in zip(size, cell, strict=True))
    return TileLayout(height, width, max(rows[0], 0), min(rows[1], frame_rows), frame_rows, frame_columns, *cell)


def _starts(first: int, last: int, size: int, cell: int) -> tuple[int, ...]:
    """Return where tiles start so that their inner parts cover [first, last), a constant step apart."""
    outside = TAPER_PX + BLEND_PX // 2
    step = (size - 2 * outside) // cell * cell
    start = -(-(first - outside - cell + 1) // cell) * cell
    count = max(1, -(-(last - first + cell) // step))
    return tuple(start + step * index for index in range(count))


def _mirrored(starts: tuple[int, ...], size: int, most: int, cell: int) -> Int[np.ndarray, "starts size"]:
    """Return the samples of each tile along one axis; beyond the frame, whole cells are mirrored."""
    index = np.array(starts)[:, None] + np.arange(size)
    cells, last = index // cell, most // cell - 1
    period = max(2 * last, 1)
    folded = np.abs((cells + last) % period - last) if last > 0 else np.zeros_like(cells)
    inside = (index >= 0) & (index < most)
    return np.where(inside, index, np.minimum(folded * cell + index % cell, most - 1))


def _run(index: Int[np.ndarray, " n"]) -> slice | Int[np.ndarray, " n"]:
    """Return consecutive indices as a slice, which needs no copy."""
    return slice(index[0], index[-1] + 1) if np.all(np.diff(index) == 1) else index


def _covered(weights: Float32[np.ndarray, " size"], starts: tuple[int, ...], most: int) -> Float32[np.ndarray, " most"]:
    """Return the sum of the tiles' weights along one axis of the frame; 1 where no tile is."""
    total = np.zeros(most, dtype=np.float32)
    for start in starts:
        part = _inside(start, len(weights), most)
        total[start + part.start : start + part.stop] += weights[part]
    return np.where(total > 0, total, np.float32(1))


def _inside(start: int, size: int, most: int) -> slice:
    """Return the part of a tile along one axis that lies on the frame and is not tapered."""
    return slice(max(TAPER_PX, -start), max(min(size - TAPER_PX, most - start), TAPER_PX))


def _ramped(size: int, zeros: int, ramp: int) -> Float32[np.ndarray, " size"]:
    """Return ones with a raised cosine of ``ramp`` samples at both ends, after ``zeros`` zeros."""
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(ramp) + 0.5) / ramp)
    half = np.concatenate([np.zeros(zeros), rise])
    return np.concatenate([half, np.ones(size - 2 * len(half)), half[::-1]]).astype(np.float32)
