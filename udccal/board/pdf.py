"""Draws the board as a PDF at 1:1: rectangles and text, no pixels."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from itertools import pairwise
from typing import final

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path
from matplotlib.transforms import Affine2D

from udccal.board.instructions import joining, sentences
from udccal.board.paper import SIDES_MM, Paper
from udccal.board.pattern import black_rectangles_mm
from udccal.board.set_up import SetUp
from udccal.board.sheets import FOOT_MM, MARGIN_MM, Strip, Tiling, tile
from udccal.errors import UdccalError

_MM_PER_INCH = 25.4
# A page of PDF has at most 14400 points per side.
_LONGEST_MM = 5080.0
# Lines of text are readable, and short enough for the narrowest page.
_NARROWEST_MM = 210.0
_LINE_MM, _LINE_LETTERS, _TEXT_POINTS = 4.6, 108, 8.0
_RULER_MM, _RULER_HEIGHT_MM = 100, 9.0
_MARK_GAP_MM, _MARK_MM, _THIN_POINTS = 1.0, 6.0, 0.4
_SKETCH_MM = 120.0


def board_pdf(rig_name: str, set_up: SetUp, paper: Paper | None) -> tuple[bytes, int]:
    """Return a PDF and its number of pages: one page of the needed size, or as many sheets of ``paper`` as it takes.

    Raises:
        UdccalError: when the board is larger than a page of PDF may be, or does not fit on sheets of ``paper``.
    """
    pages = _pages(rig_name, set_up, paper)
    file = io.BytesIO()
    facts = {"Title": f"Board of {rig_name}", "Creator": "udccal", "Producer": None, "CreationDate": None}
    with PdfPages(file, metadata=facts) as pdf:
        for page in pages:
            pdf.savefig(page.figure)
    return file.getvalue(), len(pages)


@final
class _Page:
    """One sheet, drawn on in millimetres from its top left corner."""

    def __init__(self, width_mm: float, height_mm: float) -> None:
        self.figure = Figure(figsize=(width_mm / _MM_PER_INCH, height_mm / _MM_PER_INCH))
        self._mm = Affine2D().scale(1 / width_mm, -1 / height_mm).translate(0, 1) + self.figure.transFigure

    def board(self, black: Path, columns: Strip, rows: Strip, x_mm: float, y_mm: float) -> None:
        """Draw what the strips show of the board, at a place of the sheet."""
        to_sheet = Affine2D().translate(x_mm - columns.begin_mm, y_mm - rows.begin_mm) + self._mm
        shown = PathPatch(black, facecolor="black", edgecolor="none", transform=to_sheet)
        self.figure.add_artist(shown)
        window = Rectangle((x_mm, y_mm), columns.length_mm, rows.length_mm, transform=self._mm)
        shown.set_clip_path(window)

    def box(self, x_mm: float, y_mm: float, width_mm: float, height_mm: float) -> None:
        """Draw an empty rectangle."""
        outline = Rectangle((x_mm, y_mm), width_mm, height_mm, fill=False, lw=_THIN_POINTS, transform=self._mm)
        self.figure.add_artist(outline)

    def line(self, x_mm: tuple[float, float], y_mm: tuple[float, float]) -> None:
        """Draw a thin line whose middle is exact."""
        line = Line2D(x_mm, y_mm, lw=_THIN_POINTS, color="black", solid_capstyle="butt", transform=self._mm)
        self.figure.add_artist(line)

    def text(self, x_mm: float, y_mm: float, text: str, across: str = "left") -> None:
        """Write text whose top, or whose top middle, lies at a place."""
        self.figure.text(x_mm, y_mm, text, size=_TEXT_POINTS, ha=across, va="top", transform=self._mm)

    def ruler(self, x_mm: float, y_mm: float) -> None:
        """Draw 100 mm with a mark at every millimetre."""
        self.line((x_mm, x_mm + _RULER_MM), (y_mm, y_mm))
        for mm in range(_RULER_MM + 1):
            length = 4.0 if mm % 10 == 0 else 2.5 if mm % 5 == 0 else 1.5
            self.line((x_mm + mm, x_mm + mm), (y_mm, y_mm + length))
        for mm in (0, 50, 100):
            self.text(x_mm + mm, y_mm + 4.6, f"{mm}", "center")
        self.text(x_mm + _RULER_MM + 5, y_mm + 1, "ruler, mm")

    def lines(self, x_mm: float, y_mm: float, lines: Sequence[str]) -> None:
        """Write lines of text below each other."""
        for index, line in enumerate(lines):
            self.text(x_mm, y_mm + index * _LINE_MM, line)


def _pages(rig_name: str, set_up: SetUp, paper: Paper | None) -> list[_Page]:
    lines = _wrapped(sentences(rig_name, set_up))
    width = max(set_up.width_mm + 2 * MARGIN_MM, _NARROWEST_MM)
    height = set_up.height_mm + 4 * MARGIN_MM + _RULER_HEIGHT_MM + len(lines) * _LINE_MM
    black = _path(black_rectangles_mm(set_up.board))
    if paper is None:
        if max(width, height) > _LONGEST_MM:
            raise UdccalError(
                f"Expected a page of at most {_LONGEST_MM:.0f} mm, which is all that PDF allows, found a board that "
                f"takes {width:.0f} x {height:.0f} mm. Give --paper a3 to print it on several sheets."
            )
        return [_whole(black, set_up, lines, width, height)]
    short, long = SIDES_MM[paper]
    for sides in ((short, long), (long, short)):
        if width <= sides[0] and height <= sides[1]:
            return [_whole(black, set_up, lines, *sides)]
    tiling = tile(set_up.board, paper)
    lines += _wrapped([joining(tiling.count)])
    return [_cover(tiling, set_up, lines), *_tiles(black, tiling, rig_name)]


def _whole(black: Path, set_up: SetUp, lines: Sequence[str], width_mm: float, height_mm: float) -> _Page:
    page = _Page(width_mm, height_mm)
    whole = Strip(0.0, set_up.width_mm, ()), Strip(0.0, set_up.height_mm, ())
    page.board(black, *whole, (width_mm - set_up.width_mm) / 2, MARGIN_MM)
    below = set_up.height_mm + 2 * MARGIN_MM
    page.ruler(MARGIN_MM, below)
    page.lines(MARGIN_MM, below + _RULER_HEIGHT_MM + 0.5 * MARGIN_MM, lines)
    return page


def _cover(tiling: Tiling, set_up: SetUp, lines: Sequence[str]) -> _Page:
    """Draw the first sheet: the text, the ruler, and a sketch of the joined sheets."""
    page = _Page(tiling.width_mm, tiling.height_mm)
    page.ruler(MARGIN_MM, MARGIN_MM)
    page.lines(MARGIN_MM, 2 * MARGIN_MM + _RULER_HEIGHT_MM, lines)
    top = 3 * MARGIN_MM + _RULER_HEIGHT_MM + len(lines) * _LINE_MM
    room = tiling.height_mm - MARGIN_MM - top
    scale = min(_SKETCH_MM / set_up.width_mm, room / set_up.height_mm)
    across = [0.0, *(strip.cuts_mm[-1] for strip in tiling.columns[:-1]), set_up.width_mm]
    down = [0.0, *(strip.cuts_mm[-1] for strip in tiling.rows[:-1]), set_up.height_mm]
    number = 0
    for y0, y1 in pairwise(down):
        for x0, x1 in pairwise(across):
            number += 1
            page.box(MARGIN_MM + x0 * scale, top + y0 * scale, (x1 - x0) * scale, (y1 - y0) * scale)
            page.text(MARGIN_MM + (x0 + x1) / 2 * scale, top + (y0 + y1) / 2 * scale - 1.5, f"{number}", "center")
    return page


def _tiles(black: Path, tiling: Tiling, rig_name: str) -> list[_Page]:
    pages: list[_Page] = []
    for row, rows in enumerate(tiling.rows, 1):
        for column, columns in enumerate(tiling.columns, 1):
            page = _Page(tiling.width_mm, tiling.height_mm)
            page.board(black, columns, rows, MARGIN_MM, MARGIN_MM)
            _marks(page, columns, rows)
            foot = tiling.height_mm - FOOT_MM + 2 * MARGIN_MM - 6.0
            page.ruler(MARGIN_MM, foot)
            number = f"{rig_name}, sheet {len(pages) + 1} of {tiling.count}: row {row}, column {column}"
            page.text(MARGIN_MM + _RULER_MM + 5, foot + 5.5, number)
            pages.append(page)
    return pages


def _marks(page: _Page, columns: Strip, rows: Strip) -> None:
    """Draw both ends of each seam outside the part of the board that the sheet shows."""
    for cut in columns.cuts_mm:
        x = MARGIN_MM + cut - columns.begin_mm
        for ends in _ends(rows.length_mm):
            page.line((x, x), ends)
    for cut in rows.cuts_mm:
        y = MARGIN_MM + cut - rows.begin_mm
        for ends in _ends(columns.length_mm):
            page.line(ends, (y, y))


def _ends(length_mm: float) -> tuple[tuple[float, float], tuple[float, float]]:
    before, after = MARGIN_MM - _MARK_GAP_MM, MARGIN_MM + length_mm + _MARK_GAP_MM
    return (before - _MARK_MM, before), (after, after + _MARK_MM)


def _path(rectangles: Float[np.ndarray, "rectangles 4"]) -> Path:
    """One path of all rectangles: filled at once, so that neighbours have no seam between them."""
    placed = [
        Path.unit_rectangle().transformed(Affine2D().scale(width, height).translate(x, y))
        for x, y, width, height in rectangles
    ]
    return Path.make_compound_path(*placed)


def _wrapped(said: Sequence[str]) -> list[str]:
    return [line for sentence in said for line in textwrap.wrap(sentence, _LINE_LETTERS)]
