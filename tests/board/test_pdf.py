"""The printed board, measured: by OpenCV's detector, and at its ruler."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float

from tests.board.prints import Print, corners_mm, marks_mm, printed
from udccal.arrangements import BoardSpec
from udccal.board.paper import Paper
from udccal.board.pdf import board_pdf
from udccal.board.set_up import SetUp, set_up_of
from udccal.board.sheets import MARGIN_MM, Strip, tile
from udccal.errors import RigError, UdccalError
from udccal.rig import RigDescription, load_rig

DPI = 100.0


def rig_of_focal(focal_mm: float) -> RigDescription:
    rig = load_rig("lg55-reduced")
    focal: Any = rig.lens.focal_mm.model_copy(update={"value": focal_mm})
    return rig.model_copy(update={"lens": rig.lens.model_copy(update={"focal_mm": focal})})


def expected_mm(spec: BoardSpec) -> Float[np.ndarray, "n 2"]:
    x, y = np.meshgrid(np.arange(spec.columns - 1), np.arange(spec.rows - 1))
    return np.stack([x, y], axis=-1).reshape(-1, 2) * spec.square_mm


def check_ruler(pdf: bytes, page: int, y_mm: float, scale: float = 1.0) -> None:
    """Measure the marks of centimetres, 3.2 mm below the ruler's line, where no others reach; printed at a scale."""
    line = printed(pdf, page, 600.0, (0.0, y_mm + 3.2, MARGIN_MM + 105.0, 0.3))
    marks = scale * marks_mm(line, axis=0)
    assert marks - marks[0] == pytest.approx(np.arange(11) * 10.0, abs=0.1)


def ruler_of_one_page_mm(set_up: SetUp) -> float:
    return set_up.height_mm + 2 * MARGIN_MM


@pytest.mark.medium
@pytest.mark.parametrize("name", ["lg55-aca2040", "mk31-imx1600"])
def test_a_page_holds_the_board_and_a_ruler_at_their_sizes(name: str) -> None:
    set_up = set_up_of(load_rig(name))
    pdf, pages = board_pdf(name, set_up, None)
    assert pages == 1
    assert b"/Subtype /Image" not in pdf
    found = corners_mm(printed(pdf, 0, DPI), set_up.board)
    assert np.abs(found - expected_mm(set_up.board)).max() < 0.1
    check_ruler(pdf, 0, ruler_of_one_page_mm(set_up))


@pytest.mark.medium
def test_a_print_that_was_fitted_to_the_page_is_seen() -> None:
    set_up = set_up_of(load_rig("mk31-imx1600"))
    pdf, _ = board_pdf("small", set_up, None)
    found = 0.998 * corners_mm(printed(pdf, 0, DPI), set_up.board)
    assert np.abs(found - expected_mm(set_up.board)).max() > 0.5
    with pytest.raises(AssertionError):
        check_ruler(pdf, 0, ruler_of_one_page_mm(set_up), scale=0.997)


@pytest.mark.medium
@pytest.mark.parametrize("paper", list(Paper))
def test_sheets_cut_at_their_marks_join_to_the_board(paper: Paper) -> None:
    set_up = set_up_of(load_rig("lg55-aca2040"))
    pdf, pages = board_pdf("tiled", set_up, paper)
    tiling = tile(set_up.board, paper)
    assert pages == 1 + tiling.count
    rows = []
    for row, down in enumerate(tiling.rows):
        sheets = [printed(pdf, 1 + row * len(tiling.columns) + column, DPI) for column in range(len(tiling.columns))]
        kept = slice(*_kept_px(down, sheets[0].pixel_mm[1]))
        pieces = [
            sheet.pixels[kept, slice(*_kept_px(across, sheet.pixel_mm[0]))]
            for sheet, across in zip(sheets, tiling.columns, strict=True)
        ]
        rows.append(np.hstack(pieces))
    whole = Print(np.pad(np.vstack(rows), 40, constant_values=255), (25.4 / DPI, 25.4 / DPI))
    # Pieces are cut and joined at whole pixels here, and a pixel is 0.25 mm.
    assert np.abs(corners_mm(whole, set_up.board) - expected_mm(set_up.board)).max() < 0.5
    check_ruler(pdf, 0, MARGIN_MM)


def _kept_px(strip: Strip, pixel_mm: float) -> tuple[int, int]:
    """What a person keeps of a sheet: it is cut at the seam to its right and lies on the one before."""
    first = strip.cuts_mm[0] if strip.begin_mm > 0 else 0.0
    last = strip.cuts_mm[-1] if strip.cuts_mm and strip.cuts_mm[-1] > first else strip.end_mm
    begin, end = (round((MARGIN_MM + place - strip.begin_mm) / pixel_mm) for place in (first, last))
    return begin, end


@pytest.mark.medium
@pytest.mark.parametrize("paper", list(Paper))
def test_marks_show_both_ends_of_each_seam_and_no_seam_crosses_a_corner(paper: Paper) -> None:
    set_up = set_up_of(load_rig("lg55-aca2040"))
    pdf, _ = board_pdf("tiled", set_up, paper)
    tiling = tile(set_up.board, paper)
    for strips, across in ((tiling.columns, True), (tiling.rows, False)):
        for before, after in pairwise(strips):
            assert before.cuts_mm[-1] == after.cuts_mm[0]
            assert before.cuts_mm[-1] / set_up.board.square_mm % 1 == 0.5
        edge = (0.0, 4.0, tiling.width_mm, 3.0) if across else (4.0, 0.0, 3.0, tiling.height_mm)
        marks = marks_mm(printed(pdf, 1, 300.0, edge), axis=0 if across else 1)
        assert marks == pytest.approx(MARGIN_MM + np.array(strips[0].cuts_mm), abs=0.1)


def test_a_board_that_fits_on_one_sheet_lies_on_it() -> None:
    small = set_up_of(rig_of_focal(24.0))
    assert small.width_mm < 200
    pdf, pages = board_pdf("small", small, Paper.a4)
    assert pages == 1
    assert printed(pdf, 0, 72.0).pixels.shape == (842, 596)
    found = corners_mm(printed(pdf, 0, 300.0), small.board)
    assert np.abs(found - expected_mm(small.board)).max() < 0.1


def test_boards_that_no_paper_holds_are_refused() -> None:
    wide = set_up_of(rig_of_focal(0.3))
    with pytest.raises(UdccalError, match="Expected a page of at most 5080 mm"):
        board_pdf("wide", wide, None)
    with pytest.raises(UdccalError, match="Expected paper on which a square of 1001 mm fits, found a3"):
        board_pdf("wide", wide, Paper.a3)
    with pytest.raises(RigError, match="squares are at least 1 mm, found 0 mm"):
        set_up_of(rig_of_focal(3000.0))


def test_measures_are_those_of_the_procedures_steps() -> None:
    set_up = set_up_of(load_rig("lg55-aca2040"))
    assert set_up.board == BoardSpec(12, 9, 50.0, 37.5)
    assert (set_up.led_mm, set_up.led_distance_mm, set_up.views) == (1.15, 2000.0, 20)
    # The jig holds the board's middle 700 mm before the pupil, along an axis that is tilted by 17 degrees.
    assert set_up.jig_mm[2] == pytest.approx(700 * np.cos(np.deg2rad(17)) - 14, abs=1)
    assert 450 < set_up.views_mm[0] < set_up.views_mm[1] < 1250


def test_a_procedure_without_a_jig_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class NoSteps:
        def steps(self, rig: RigDescription) -> tuple[()]:
            return ()

    monkeypatch.setattr("udccal.board.set_up.find_procedure", lambda term: NoSteps)
    with pytest.raises(RigError, match="a step with a board on a jig, found none"):
        set_up_of(load_rig("lg55-reduced"))
