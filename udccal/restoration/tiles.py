"""A mosaic in overlapping tiles, each small enough for one brightness, and their pictures joined again.

Neighbouring tiles may share a kernel.

A tile's border is tapered before its transform, so that opposite edges meet at zero; only what the taper leaves whole
is used. There, neighbouring tiles are blended.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int, Real, Shaped
from scipy import fft

from udccal.errors import RestorationError

# Part of the frame within which tiles share a kernel: behind a display, kernels vary more slowly than a scene does.
SHARED: Final = 0.2
# A tile's part that is neither tapered nor blended must hold the bands of its noise.
_LEAST_WHOLE_PX: Final = 16


@final
@dataclass(frozen=True)
class Margins:
    """Ends of a tile along one axis, in px.

    Attributes:
        taper: samples that fade out towards the end; nothing of them is used.
        blend: samples next to these, in which neighbouring tiles are blended.
    """

    taper: int
    blend: int

    @property
    def outside(self) -> int:
        """From a tile's end to the middle of its blend."""
        return self.taper + self.blend // 2

    @property
    def both(self) -> int:
        """From a tile's end to what is neither tapered nor blended."""
        return self.taper + self.blend


# Down and across. Most of what a display's pixel rows blur lies within a few px, and less of it across than down.
BEHIND_A_DISPLAY: Final = Margins(20, 8), Margins(12, 12)
# Of kernels of any kind.
GENERAL: Final = Margins(24, 16), Margins(24, 16)
LEAST_PX: Final = 2 * max(each.both for each in (*BEHIND_A_DISPLAY, *GENERAL)) + _LEAST_WHOLE_PX


@final
@dataclass(frozen=True)
class Strip:
    """One tile along one axis.

    Attributes:
        part: of the tile, what is used.
        at: where it lies in the joined picture.
        weights: of its samples in the blend; those of all tiles sum to 1.
        middle: of the whole tile in the joined picture, in px.
    """

    part: slice
    at: slice
    weights: Float32[np.ndarray, " part"]
    middle: float


@final
@dataclass(frozen=True)
class TileLayout:
    """Tiles that cover some rows of a frame.

    Attributes:
        rows, columns: size of a tile, multiples of the colour pattern's cell.
        first_row, last_row: rows of the frame that are covered, the last one excluded. frame_rows: the frame's rows.
        frame_columns: the frame's columns; all are covered.
        cell_rows, cell_columns: the colour pattern's cell; every tile starts at the beginning of one.
        down, across: ends of a tile.
        shared: part of the frame within which neighbouring tiles share a kernel; 0 for a kernel each.
    """

    rows: int
    columns: int
    first_row: int
    last_row: int
    frame_rows: int
    frame_columns: int
    cell_rows: int
    cell_columns: int
    down: Margins = BEHIND_A_DISPLAY[0]
    across: Margins = BEHIND_A_DISPLAY[1]
    shared: float = SHARED

    @functools.cached_property
    def tops(self) -> tuple[int, ...]:
        """First row of each row of tiles; it may lie outside the frame."""
        return _starts(self.first_row, self.last_row, self.rows, self.cell_rows, self.down)

    @functools.cached_property
    def lefts(self) -> tuple[int, ...]:
        """First column of each column of tiles; it may lie outside the frame."""
        return _starts(0, self.frame_columns, self.columns, self.cell_columns, self.across)

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
    def kernel(self) -> Int[np.ndarray, " tiles"]:
        """Number of each tile's kernel; kernels are numbered row by row."""
        down, across = self._kernels
        return (down[:, None] * (across[-1] + 1) + across).ravel()

    @functools.cached_property
    def _kernels(self) -> tuple[Int[np.ndarray, " tiles_down"], Int[np.ndarray, " tiles_across"]]:
        """Row of kernels of each row of tiles, and column of each column."""
        down, across = (
            np.arange(len(starts)) // max(1, int(self.shared * most / _step(*tile)))
            for starts, most, tile in (
                (self.tops, self.frame_rows, (self.rows, self.cell_rows, self.down)),
                (self.lefts, self.frame_columns, (self.columns, self.cell_columns, self.across)),
            )
        )
        return down, across

    @property
    def kernel_middles(self) -> tuple[Float64[np.ndarray, " kernels_down"], Float64[np.ndarray, " kernels_across"]]:
        """Where kernels are evaluated, in px of the joined picture: in the middle of the tiles that share one."""
        down, across = (
            np.bincount(own, [strip.middle for strip in strips]) / np.bincount(own)
            for own, strips in zip(self._kernels, self.strips, strict=True)
        )
        return down, across

    @property
    def kernel_px(self) -> Float64[np.ndarray, "kernels 2"]:
        """The same on the sensor, as (x, y)."""
        down, across = self.kernel_middles
        return np.stack(np.meshgrid(across, down + self.first_row), axis=-1).reshape(-1, 2)

    @functools.cached_property
    def taper(self) -> Float32[np.ndarray, "rows columns"]:
        """Weights of a tile's samples before the transform."""
        return _ramped(self.rows, 0, self.down.taper)[:, None] * _ramped(self.columns, 0, self.across.taper)

    @functools.cached_property
    def power(self) -> float:
        """Samples of a tile, each weighted by the square of its taper."""
        return float(np.sum(self.taper**2))

    @property
    def reach(self) -> slice:
        """Rows of the frame that the tiles see: the strip."""
        return slice(max(self.tops[0], 0), min(self.tops[-1] + self.rows, self.frame_rows))

    @property
    def inner(self) -> slice:
        """Rows of the strip that are covered."""
        return slice(self.first_row - self.reach.start, self.last_row - self.reach.start)

    def cut(self, strip: Float32[np.ndarray, "strip_rows frame_columns"]) -> Float32[np.ndarray, "tiles rows columns"]:
        """Return copies of the ``tiles`` of a frame's rows ``reach``."""
        return np.stack(self.tiles(strip))

    def tiles(self, strip: Shaped[np.ndarray, "strip_rows frame_columns"]) -> list[Shaped[np.ndarray, "rows columns"]]:
        """Return the tiles of a frame's rows ``reach``, as views of one copy: at its borders the frame is mirrored.

        Whole cells are mirrored, so that every tile has the same pattern.
        """
        rows, columns = self._seen
        top, left = self.reach.start - self.tops[0], -self.lefts[0]
        wide = np.empty((len(rows), len(columns)), dtype=strip.dtype)
        wide[top : top + len(strip), left : left + self.frame_columns] = strip
        for beyond in (slice(top), slice(top + len(strip), None)):
            wide[beyond] = wide[rows[beyond] + top]
        for beyond in (slice(left), slice(left + self.frame_columns, None)):
            wide[:, beyond] = wide[:, columns[beyond] + left]
        places = itertools.product((at - self.tops[0] for at in self.tops), (at + left for at in self.lefts))
        return [wide[y : y + self.rows, x : x + self.columns] for y, x in places]

    @functools.cached_property
    def _seen(self) -> tuple[Int[np.ndarray, " high"], Int[np.ndarray, " wide"]]:
        """Rows of the strip, and columns, from the first tile's first to the last tile's last."""
        rows, columns = (
            _mirrored(at[:1], at[-1] + size - at[0], most, cell)[0]
            for at, size, most, cell in (
                (self.tops, self.rows, self.frame_rows, self.cell_rows),
                (self.lefts, self.columns, self.frame_columns, self.cell_columns),
            )
        )
        return rows - self.reach.start, columns

    @property
    def samples(self) -> tuple[Int[np.ndarray, "tiles_down rows"], Int[np.ndarray, "tiles_across columns"]]:
        """Rows of the strip, and columns, of each row and column of tiles."""
        rows = _mirrored(self.tops, self.rows, self.frame_rows, self.cell_rows) - self.reach.start
        return rows, _mirrored(self.lefts, self.columns, self.frame_columns, self.cell_columns)

    def blend(
        self,
        picture: Float32[np.ndarray, "rows columns 3"],
        index: int,
        joined: Float32[np.ndarray, "covered_rows frame_columns 3"],
    ) -> None:
        """Add a tile's picture, by its weights, to that of the rows that are covered."""
        places = divmod(index, len(self.lefts))
        down, across = (strips[place] for strips, place in zip(self.strips, places, strict=True))
        weights = cv2.merge([np.outer(down.weights, across.weights)] * 3)
        cv2.accumulateProduct(picture[down.part, across.part], weights, joined[down.at, across.at])

    def join(
        self, pictures: Float32[np.ndarray, "tiles rows columns 3"]
    ) -> Float32[np.ndarray, "covered_rows frame_columns 3"]:
        """Blend the tiles' pictures into one of the rows that are covered."""
        joined = np.zeros((*self.covered, 3), dtype=np.float32)
        for index, picture in enumerate(pictures):
            self.blend(picture, index, joined)
        return joined

    @property
    def covered(self) -> tuple[int, int]:
        """Rows and columns of the joined picture."""
        return self.last_row - self.first_row, self.frame_columns

    @functools.cached_property
    def strips(self) -> tuple[list[Strip], list[Strip]]:
        """The tiles along both axes of the joined picture."""
        return (
            _blended(self.tops, self.rows, self.first_row, self.last_row, self.down),
            _blended(self.lefts, self.columns, 0, self.frame_columns, self.across),
        )

    def by_place(self, values: Real[np.ndarray, "tiles *k"]) -> Real[np.ndarray, "tiles_down tiles_across *k"]:
        """Return the tiles' values by row and column of tiles."""
        return values.reshape(len(self.tops), len(self.lefts), *values.shape[1:])


def layout_for(
    frame_rows: int,
    frame_columns: int,
    cell: tuple[int, int],
    largest: tuple[int, int],
    rows: tuple[int, int],
    margins: tuple[Margins, Margins] = BEHIND_A_DISPLAY,
    shared: float = SHARED,
) -> TileLayout:
    """Return the tiles that cover the ``rows`` (first, past the last) of a frame: as few as possible, then as small.

    Args:
        frame_rows: rows of the frame. frame_columns: columns of the frame.
        cell: (rows, columns) of the colour pattern.
        largest: (rows, columns) of a tile at most, rounded up to whole cells.
        rows: first row to be covered, and the row after the last one.
        margins: ends of a tile, down and across.
        shared: part of the frame within which neighbouring tiles share a kernel; 0 for a kernel each.

    Raises:
        RestorationError: when a tile is too small to have a part that is neither tapered nor blended.
    """
    if min(largest) < LEAST_PX:
        raise RestorationError(
            f"Expected tiles of at least {LEAST_PX} x {LEAST_PX} px, found {largest[1]} x {largest[0]}. "
            "Give larger ones."
        )
    first, last = max(rows[0], 0), min(rows[1], frame_rows)
    down, across = margins
    height = _fitted(last - first, largest[0], cell[0], down)
    width = _fitted(frame_columns, largest[1], cell[1], across)
    return TileLayout(height, width, first, last, frame_rows, frame_columns, *cell, down, across, shared)


def _fitted(span: int, largest: int, cell: int, ends: Margins) -> int:
    """Return the smallest size of tiles, of whole cells and with a fast transform, that needs no more tiles."""
    most = -(-largest // cell) * cell
    count = -(-(span + cell) // (most - 2 * ends.outside))
    needed = max(-(-(span + cell) // count) + 2 * ends.outside, LEAST_PX)
    return min(most, cell * int(fft.next_fast_len(-(-needed // cell), real=True)))


def _step(size: int, cell: int, ends: Margins) -> int:
    """Return how far from each other tiles start."""
    return (size - 2 * ends.outside) // cell * cell


def _starts(first: int, last: int, size: int, cell: int, ends: Margins) -> tuple[int, ...]:
    """Return where tiles start so that their inner parts cover [first, last), a constant step apart."""
    step = _step(size, cell, ends)
    start = -(-(first - ends.outside - cell + 1) // cell) * cell
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


def _blended(starts: tuple[int, ...], size: int, first: int, last: int, ends: Margins) -> list[Strip]:
    """Return the strips of [first, last) along one axis."""
    ramp, total = _ramped(size, ends.taper, ends.blend), np.zeros(last - first, dtype=np.float32)
    places = []
    for start in starts:
        part = slice(max(ends.taper, first - start), max(min(size - ends.taper, last - start), ends.taper))
        at = slice(start + part.start - first, start + part.stop - first)
        total[at] += ramp[part]
        places.append((part, at))
    return [
        Strip(part, at, ramp[part] / total[at], start - first + (size - 1) / 2)
        for start, (part, at) in zip(starts, places, strict=True)
    ]


def _ramped(size: int, zeros: int, ramp: int) -> Float32[np.ndarray, " size"]:
    """Return ones with a raised cosine of ``ramp`` samples at both ends, after ``zeros`` zeros."""
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(ramp) + 0.5) / ramp)
    half = np.concatenate([np.zeros(zeros), rise])
    return np.concatenate([half, np.ones(size - 2 * len(half)), half[::-1]]).astype(np.float32)
