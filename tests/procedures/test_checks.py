from __future__ import annotations

import cv2
import numpy as np
import pytest

from procedures.checks import is_dark, is_even, refuse_far_exposure, shows_board, shows_led, usual_exposure_s
from udccal.arrangements import Arrangement, Board, BoardSpec, FlatLight, Led
from udccal.cameras.protocol import Frame, Region, Settings
from udccal.errors import CaptureError
from udccal.rig import load_rig

RIG = load_rig("lg55-reduced")
SPEC = BoardSpec(7, 5, 60.0, 45.0)


def frame(data: np.ndarray, x: int = 100, y: int = 100, exposure_s: float = 0.01) -> Frame:
    region = Region(x, y, data.shape[1], data.shape[0])
    return Frame(np.rint(data).clip(0, 4095).astype(np.uint16), Settings(exposure_s, 0.0, region), 0.0, 0, True)


def board_picture(columns: int = 640, rows: int = 480) -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)
    board = cv2.aruco.CharucoBoard((SPEC.columns, SPEC.rows), SPEC.square_mm, SPEC.marker_mm, dictionary)
    picture = board.generateImage((columns, rows), marginSize=40).astype(float)
    picture[::2, ::2] *= 0.5  # as a Bayer mosaic has it
    return 64 + picture * 10


def test_dark_is_told_from_light() -> None:
    rng = np.random.default_rng(0)
    is_dark(frame(rng.normal(66, 3, (64, 64))), RIG)
    is_dark(frame(rng.normal(64 + 0.355 * 200, 8, (64, 64)), exposure_s=10.0), RIG)  # dark current
    with pytest.raises(CaptureError, match=r"Expected a dark frame, found .* Cap the lens"):
        is_dark(frame(rng.normal(150, 8, (64, 64))), RIG)


def test_a_shadow_in_a_flat_is_found() -> None:
    flat = np.full((96, 128), 2500.0)
    flat[::2, ::2] *= 0.5
    is_even(frame(flat), RIG)
    flat[20:60, 30:70] = 80
    with pytest.raises(CaptureError, match=r"Expected an even light .* patches at 1%"):
        is_even(frame(flat), RIG)


@pytest.mark.parametrize(("row", "column", "fine"), [(24, 16, True), (31, 10, True), (2, 16, False), (24, 29, False)])
def test_an_led_must_be_where_it_was_aimed_at(row: int, column: int, fine: bool) -> None:
    data = np.full((48, 32), 66.0)
    data[row - 1 : row + 2, column - 1 : column + 2] = 900
    data[row, column] = 3000
    check = shows_led(100 + 16.4, 100 + 24.3)
    if fine:
        check(frame(data), RIG)
    else:
        found = f"found it at column {100 + column}, row {100 + row}. Move the LED .* (22 px down|13 px left)"
        with pytest.raises(CaptureError, match=found):
            check(frame(data), RIG)


def test_a_leak_in_a_part_of_a_dark_frame_is_told_and_hot_pixels_are_not() -> None:
    rng = np.random.default_rng(0)
    dark = rng.normal(64, 3, (192, 256))
    dark[rng.integers(0, 192, 300), rng.integers(0, 256, 300)] = 4000
    is_dark(frame(dark), RIG)
    dark[:70, :90] += 60
    with pytest.raises(CaptureError, match="at least a part"):
        is_dark(frame(dark), RIG)


def test_a_lit_room_is_not_dark_enough_for_an_led() -> None:
    data = np.full((48, 32), 2000.0)
    data[20:23, 12:15] = 3000
    with pytest.raises(CaptureError, match="Darken the room"):
        shows_led(113.0, 121.0)(frame(data), RIG)


def test_a_board_is_found_and_its_absence_told() -> None:
    check = shows_board(SPEC)
    check(frame(board_picture()), RIG)
    with pytest.raises(CaptureError, match=r"at least 6 corners of the 7 x 5 ChArUco board, found 0"):
        check(frame(np.full((480, 640), 500.0)), RIG)


@pytest.mark.parametrize(("found_s", "way"), [(8.0, "1000 times too long"), (8e-6, "1000 times too short")])
def test_an_exposure_that_is_far_off_is_refused(found_s: float, way: str) -> None:
    for near_s in (8e-3, 0.5, 1e-4):
        refuse_far_exposure(near_s, 8e-3)
    with pytest.raises(CaptureError, match=rf"Expected an exposure near 0.008 s.* {way}\. .*milliseconds"):
        refuse_far_exposure(found_s, 8e-3)


@pytest.mark.parametrize(
    "arrangement",
    [Led(1.0, 2.0, 2e3, 1.0), FlatLight(), Board(SPEC, (0.0, 0.0, 0.0), (0.0, 0.0, 700.0), parallel_to_panel=True)],
)
def test_a_usual_exposure_in_milliseconds_is_far_from_usual(arrangement: Arrangement) -> None:
    usual_s = usual_exposure_s(arrangement)
    for factor in (0.2, 1.0, 5.0):
        refuse_far_exposure(factor * usual_s, usual_s)
        with pytest.raises(CaptureError, match="too long"):
            refuse_far_exposure(1000 * factor * usual_s, usual_s)
