from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.simulation.toy import toy_truth
from udccal.arrangements import Board, BoardSpec, Photograph
from udccal.simulation.blur import build_blur
from udccal.simulation.board import board_corners_mm, opencv_board
from udccal.simulation.panorama import panorama_view
from udccal.simulation.rays import slope_grid
from udccal.simulation.scene import WHITE_E_PER_S, ideal_view, render_board, render_photograph
from udccal.simulation.truth import RigTruth, directions_to_pixels, pixels_to_directions

SPEC = BoardSpec(columns=5, rows=4, square_mm=30.0, marker_mm=20.0)


@pytest.fixture(scope="module")
def truth() -> RigTruth:
    """The middle of the sensor, twice as large as the toy: room for a board."""
    toy = toy_truth()
    camera = toy.description.camera.model_copy(update={"columns": 256, "rows": 192})
    optics = replace(toy.optics, cx_px=127.0, cy_px=96.0)
    return replace(toy, description=toy.description.model_copy(update={"camera": camera}), optics=optics)


def board_before(truth: RigTruth, rotation_vector: tuple[float, float, float]) -> Board:
    """A board whose middle lies on the ray of the sensor's middle."""
    ray = pixels_to_directions(truth.optics, np.array([127.5, 95.5]))
    rotation, _ = cv2.Rodrigues(np.array(rotation_vector))
    half = rotation @ np.array([SPEC.columns, SPEC.rows, 0]) * SPEC.square_mm / 2
    corner = truth.optics.pupil_mm + ray / ray[2] * 600.0 - half
    return Board(SPEC, rotation_vector, (float(corner[0]), float(corner[1]), float(corner[2])))


def true_corners(truth: RigTruth, board: Board) -> np.ndarray:
    rotation, _ = cv2.Rodrigues(np.array(board.rotation_vector))
    points = board_corners_mm(board.spec) @ rotation.T + np.array(board.translation_mm)
    return directions_to_pixels(truth.optics, points - truth.optics.pupil_mm)


def refined(image: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Saddle points of a smoothed picture: what OpenCV finds is then good to a few hundredths of a pixel."""
    smooth = cv2.GaussianBlur(image[..., 1] / WHITE_E_PER_S, (0, 0), 1.5).astype(np.float32)
    corners = start.astype(np.float32).reshape(-1, 1, 2)
    return cv2.cornerSubPix(smooth, corners, (6, 6), (-1, -1), (3, 200, 1e-5)).reshape(-1, 2)


TILTED = (0.25, -0.2, 0.15)


@pytest.mark.parametrize("rotation", [(0.0, 0.0, 0.0), TILTED])
def test_board_corners_are_where_the_rig_projects_them(truth: RigTruth, rotation: tuple[float, float, float]):
    board = replace(board_before(truth, rotation), spec=replace(SPEC, marker_mm=10.0))
    expected = true_corners(truth, board)
    found = refined(render_board(truth, board), expected + 0.4)
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.05
    assert np.abs((found - expected).mean(axis=0)).max() < 0.02


def test_a_shifted_board_is_noticed(truth: RigTruth):
    board = replace(board_before(truth, TILTED), spec=replace(SPEC, marker_mm=10.0))
    x, y, z = board.translation_mm
    wrong = true_corners(truth, replace(board, translation_mm=(x + 0.1, y, z)))
    assert np.abs((refined(render_board(truth, board), wrong) - wrong).mean(axis=0)).max() > 0.08


@pytest.mark.parametrize("rotation", [(0.0, 0.0, 0.0), TILTED])
def test_opencv_recognises_every_corner(truth: RigTruth, rotation: tuple[float, float, float]):
    board = board_before(truth, rotation)
    eight_bit = np.clip(render_board(truth, board) * (230 / WHITE_E_PER_S), 0, 255).astype(np.uint8)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(opencv_board(SPEC)).detectBoard(eight_bit)
    assert len(ids) == 12
    assert np.abs(corners.reshape(-1, 2) - true_corners(truth, board)[ids.reshape(-1)]).max() < 0.4


def test_board_levels(truth: RigTruth):
    image = render_board(truth, board_before(truth, (0.0, 0.0, 0.0))) / WHITE_E_PER_S
    assert image.max() == pytest.approx(1.0, abs=1e-6)
    assert image.min() == pytest.approx(0.04, abs=1e-6)
    assert image[0, 0, 0] == pytest.approx(0.35, abs=1e-6)


def test_blurred_board_is_darker_at_its_peaks(truth: RigTruth):
    blur = build_blur(truth, 2, 2, 33, 17)
    board = board_before(truth, (0.0, 0.0, 0.0))
    blurred = render_board(truth, board, blur)
    assert blurred.shape == (192, 256, 3)
    assert blurred.std() < render_board(truth, board).std()


def test_slopes_between_knots_are_exact(truth: RigTruth):
    x, y = np.arange(-20.3, 270.0, 7.0), np.arange(-9.7, 200.0, 5.0)
    directions = pixels_to_directions(truth.optics, np.stack(np.meshgrid(x, y), axis=-1))
    error = slope_grid(truth, x, y) - directions[..., :2] / directions[..., 2:]
    assert np.abs(error).max() * truth.optics.fx_px < 1e-5


def waves(rows: int = 300, columns: int = 400) -> np.ndarray:
    y, x = np.mgrid[:rows, :columns]
    plane = [0.5 + 0.4 * np.sin(x / 17.0), 0.5 + 0.4 * np.cos(y / 13.0), 0.5 + 0.3 * np.sin((x + y) / 23.0)]
    return np.stack(plane, axis=-1)


def test_photograph_agrees_with_the_ideal_view_along_the_same_rays(truth: RigTruth):
    photograph = Photograph(waves(), 1000.0, 2000.0)
    seen = render_photograph(truth, photograph)
    focal, centre = 900.0, (150.0, -100.0)
    ideal = ideal_view(truth, photograph, focal, centre, 300, 220)
    slopes = slope_grid(truth, np.arange(256.0), np.arange(192.0)) * focal + np.array(centre)
    resampled = cv2.remap(ideal, slopes[..., 0].astype(np.float32), slopes[..., 1].astype(np.float32), cv2.INTER_CUBIC)
    inside = ((slopes > 2) & (slopes < [297, 217])).all(axis=-1)
    assert inside.mean() > 0.5
    assert np.abs(seen - resampled)[inside].max() < 0.01 * WHITE_E_PER_S


def test_photograph_is_centred_on_the_middle_pixel_and_scaled(truth: RigTruth):
    radiance = np.zeros((101, 101, 3))
    radiance[45:56, 45:56] = 1.0
    seen = render_photograph(truth, Photograph(radiance, 1000.0, 2000.0))[..., 0]
    y, x = np.mgrid[:192, :256]
    assert (seen * x).sum() / seen.sum() == pytest.approx(127.5, abs=0.3)
    assert (seen * y).sum() / seen.sum() == pytest.approx(95.5, abs=0.3)
    assert np.median(seen[90:102, 122:134]) == pytest.approx(WHITE_E_PER_S, rel=0.05)
    width_px = 1000.0 * 11 / 101 / (2000.0 - truth.optics.pupil_mm[2]) * truth.optics.fx_px
    assert seen.sum() / WHITE_E_PER_S == pytest.approx(width_px**2, rel=0.3)


def test_photograph_is_mirrored_outside(truth: RigTruth):
    seen = render_photograph(truth, Photograph(waves(30, 40) + 0.1, 100.0, 2000.0))
    assert seen.min() > 0


def test_panorama_looks_where_it_is_told():
    width, height = 512, 256
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    panorama = np.stack([column / width, row / height, np.ones_like(row, float)], axis=-1)
    view = panorama_view(panorama, 20.0, 10.0, 60.0, 161, 91)
    assert view[45, 80, 0] == pytest.approx(0.5 + 20 / 360, abs=0.002)
    assert view[45, 80, 1] == pytest.approx(0.5 - 10 / 180, abs=0.003)
    assert view[45, 160, 0] > view[45, 0, 0]
    assert view[90, 80, 1] > view[0, 80, 1]
    across_the_seam = panorama_view(np.ones((64, 128, 3)), 180.0, 0.0, 60.0, 41, 31)
    assert np.allclose(across_the_seam, 1.0)
