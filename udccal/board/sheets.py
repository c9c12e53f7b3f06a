"""Which part of a board each sheet of paper shows, and where the sheets are cut to be joined."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

from udccal.arrangements import BoardSpec
from udccal.board.paper import SIDES_MM, Paper
from udccal.errors import UdccalError

# A sheet's blank edges; below, there is room for the marks of cuts and for the ruler.
MARGIN_MM, FOOT_MM = 10.0, 28.0
# Both of two neighbours show this much of the board around their seam.
_OVERLAP_MM = 10.0


@final
@dataclass(frozen=True)
class Strip:
    """What one row or column of sheets shows of the board: from ``begin_mm`` to ``end_mm``, cut at ``cuts_mm``."""

    begin_mm: float
    end_mm: float
    cuts_mm: tuple[float, ...]

    @property
    def length_mm(self) -> float:
        """Length of the part that is shown."""
        return self.end_mm - self.begin_mm


@final
@dataclass(frozen=True)
class Tiling:
    """Sheets of one size, each with the part of the board in one column and one row of them."""

    width_mm: float
    height_mm: float
    columns: tuple[Strip, ...]
    rows: tuple[Strip, ...]

    @property
    def count(self) -> int:
        """How many sheets there are."""
        return len(self.columns) * len(self.rows)


def tile(spec: BoardSpec, paper: Paper) -> Tiling:
    """Spread a board over sheets, upright or lying, whichever takes fewer.

    Seams run through the middle of squares, where no corner is.

    Raises:
        UdccalError: when a square does not fit on a sheet.
    """
    short, long = SIDES_MM[paper]
    found = [one for one in (_tiled(spec, short, long), _tiled(spec, long, short)) if one is not None]
    best = min(found, key=lambda one: one.count, default=None)
    if best is None:
        raise UdccalError(
            f"Expected paper on which a square of {spec.square_mm:g} mm fits, found {paper}. Leave --paper out and "
            "let a print shop print the board in one piece."
        )
    return best


def _tiled(spec: BoardSpec, width_mm: float, height_mm: float) -> Tiling | None:
    columns = _strips(spec.columns, spec.square_mm, width_mm - 2 * MARGIN_MM)
    rows = _strips(spec.rows, spec.square_mm, height_mm - MARGIN_MM - FOOT_MM)
    return None if columns is None or rows is None else Tiling(width_mm, height_mm, columns, rows)


def _strips(squares: int, square_mm: float, room_mm: float) -> tuple[Strip, ...] | None:
    """Cut a side of so many squares into strips no longer than ``room_mm``; None where a square is too long for it."""
    half = _OVERLAP_MM / 2
    strips: list[Strip] = []
    begin = 0.0
    before: tuple[float, ...] = ()
    while squares * square_mm - begin > room_mm:
        cut = (math.floor((begin + room_mm - half) / square_mm - 0.5) + 0.5) * square_mm
        if cut - half <= begin:
            return None
        strips.append(Strip(begin, cut + half, (*before, cut)))
        begin, before = cut - half, (cut,)
    return (*strips, Strip(begin, squares * square_mm, before))
