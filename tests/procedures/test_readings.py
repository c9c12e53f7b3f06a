"""Readings of a board: how it leans, and when that cannot be told."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from procedures.aiming import board_facing, board_parallel, nominal_pixels
from procedures.geometry import board_spec
from procedures.readings import CornersSeen, lean
from udccal.arrangements import Board
from udccal.rig import load_rig

RIG = load_rig("lg55-aca2040")
SPEC = board_spec(RIG)
MIDDLE = ((RIG.camera.columns - 1) / 2, (RIG.camera.rows - 1) / 2)


def seen(board: Board, numbers: np.ndarray) -> CornersSeen:
    """Corners as a nominal camera sees them."""
    down, across = np.divmod(numbers, SPEC.columns - 1)
    on_board = np.stack([across + 1.0, down + 1.0, 0.0 * down], axis=1) * SPEC.square_mm
    places = Rotation.from_rotvec(board.rotation_vector).apply(on_board) + np.array(board.translation_mm)
    return CornersSeen(numbers, nominal_pixels(RIG, places))


ALL = np.arange((SPEC.columns - 1) * (SPEC.rows - 1))


def test_a_board_on_the_jig_does_not_lean_and_others_do() -> None:
    on_jig = lean(seen(board_parallel(RIG, SPEC, 700.0), ALL), SPEC, RIG)
    assert on_jig.value == pytest.approx(0.0, abs=1e-3)
    assert on_jig.ok
    # A board that faces the camera leans by the camera's tilt and yaw, some 17 degrees.
    held = lean(seen(board_facing(RIG, SPEC, MIDDLE, 700.0, (0.0, 0.0, 0.0)), ALL), SPEC, RIG)
    assert held.value == pytest.approx(17.0, abs=0.1)
    assert not held.ok


@pytest.mark.parametrize(
    "numbers", [ALL[:0], ALL[:5], ALL[: SPEC.columns - 1], ALL[:: SPEC.columns - 1], ALL[:: SPEC.columns][:6]]
)
def test_few_corners_and_corners_in_a_line_do_not_tell(numbers: np.ndarray) -> None:
    found = lean(seen(board_parallel(RIG, SPEC, 700.0), numbers), SPEC, RIG)
    assert math.isinf(found.value)
    assert not found.ok
    together = lean(CornersSeen(ALL, np.zeros((len(ALL), 2))), SPEC, RIG)
    assert not together.ok or math.isfinite(together.value)
