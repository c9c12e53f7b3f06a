from __future__ import annotations

import cv2
import numpy as np
import pytest

from procedures.aiming import (
    board_facing,
    board_parallel,
    low_discrepancy,
    nominal_pixels,
    nominal_ray,
)
from udccal.arrangements import Board, BoardSpec
from udccal.mounting import nominal_pupil_mm, nominal_rotation
from udccal.rig import load_rig

RIG = load_rig("lg55-aca2040")
SPEC = BoardSpec(12, 9, 50.0, 37.5)


def centre_px(board: Board) -> np.ndarray:
    half = np.array([[board.spec.columns, board.spec.rows, 0]]) * board.spec.square_mm / 2
    turn = cv2.Rodrigues(np.array(board.rotation_vector))[0]
    return nominal_pixels(RIG, half @ turn.T + np.array(board.translation_mm))[0]


def test_the_camera_looks_down_for_a_positive_tilt() -> None:
    axis = nominal_rotation(RIG)[:, 2]
    assert np.rad2deg(np.arcsin(axis[1])) == pytest.approx(RIG.mounting.tilt_deg.value, abs=0.1)


def test_rays_and_pixels_are_inverse() -> None:
    for pixel in ((0.0, 0.0), (2047.0, 300.5)):
        point = nominal_pupil_mm(RIG) + 900 * nominal_ray(RIG, *pixel)
        np.testing.assert_allclose(nominal_pixels(RIG, point[None])[0], pixel, atol=1e-6)


def test_boards_are_seen_where_they_are_asked_for() -> None:
    board = board_facing(RIG, SPEC, (400.0, 1200.0), 800.0, (0.5, -0.4, 0.3))
    np.testing.assert_allclose(centre_px(board), (400, 1200), atol=1e-6)
    jig = board_parallel(RIG, SPEC, 700.0)
    assert jig.parallel_to_panel
    assert jig.rotation_vector == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(centre_px(jig), (1023.5, 767.5), atol=1e-6)


def test_a_lean_is_the_angle_to_the_camera() -> None:
    board = board_facing(RIG, SPEC, (1023.5, 767.5), 800.0, (0.5, 0.0, 0.0))
    normal = cv2.Rodrigues(np.array(board.rotation_vector))[0][:, 2]
    assert np.arccos(normal @ nominal_rotation(RIG)[:, 2]) == pytest.approx(0.5, abs=1e-9)


@pytest.mark.parametrize("dimensions", [2, 4])
def test_low_discrepancy_points_fill_the_cube_evenly(dimensions: int) -> None:
    points = low_discrepancy(64, dimensions)
    assert points.min() >= 0
    assert points.max() < 1
    for axis in range(dimensions):
        assert np.histogram(points[:, axis], 8, (0, 1))[0].min() >= 4
