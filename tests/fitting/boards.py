"""Boards drawn ray by ray for a known geometry, apart from the simulator."""

from __future__ import annotations

import cv2
import jax
import numpy as np

from udccal.arrangements import BoardSpec
from udccal.fitting.corners import board_points_mm, charuco_board
from udccal.models.geometry import Geometry, project, unproject

SPEC = BoardSpec(columns=7, rows=5, square_mm=40.0, marker_mm=30.0)
SIZE = (320, 240)
CAMERA = Geometry(
    focal=np.array([300.0, 300.4]),
    centre=np.array([161.0, 118.0]),
    distortion=np.array([-0.08, 0.03, 4e-4, -3e-4, 0.0]),
    rotation=np.zeros(3),
    pupil=np.zeros(3),
)
_TEXELS = 40


def pose(rotation: tuple[float, float, float], centre_mm: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Board to camera: rotation vector and the place of the board's middle."""
    matrix = cv2.Rodrigues(np.array(rotation))[0]
    middle = np.array([SPEC.columns, SPEC.rows, 0]) * SPEC.square_mm / 2
    return matrix, np.array(centre_mm) - matrix @ middle


def true_corners(matrix: np.ndarray, translation: np.ndarray) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(project(CAMERA, board_points_mm(SPEC) @ matrix.T + translation))


def draw(matrix: np.ndarray, translation: np.ndarray, samples: int = 4) -> np.ndarray:
    """Picture of the board, 1 for white, box-sampled ``samples`` x ``samples`` per pixel."""
    image = charuco_board(SPEC).generateImage((SPEC.columns * _TEXELS, SPEC.rows * _TEXELS), marginSize=0) / 255.0
    fine = (np.arange(SIZE[0] * samples) + 0.5) / samples - 0.5, (np.arange(SIZE[1] * samples) + 0.5) / samples - 0.5
    pixels = np.stack(np.meshgrid(*fine), axis=-1).reshape(-1, 2)
    with jax.enable_x64(True):
        ideal = np.asarray(unproject(CAMERA, pixels))
    rays = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1) @ matrix
    origin = -matrix.T @ translation
    points = origin[:2] - rays[:, :2] * (origin[2] / rays[:, 2:])
    texel = np.floor(points / SPEC.square_mm * _TEXELS).astype(int)
    inside = ((texel >= 0) & (texel < np.array(image.shape[::-1]))).all(axis=1)
    texel = np.where(inside[:, None], texel, 0)
    value = np.where(inside, 0.05 + 0.9 * image[texel[:, 1], texel[:, 0]], 0.4)
    return value.reshape(SIZE[1], samples, SIZE[0], samples).mean(axis=(1, 3))
