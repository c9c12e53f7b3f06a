"""Boards drawn ray by ray for a known geometry, apart from the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import jax
import numpy as np
from scipy.spatial.transform import Rotation

from udccal.arrangements import BoardSpec
from udccal.board.charuco import board_points_mm, charuco_board
from udccal.fitting.geometry.bundle import Intrinsics, projected
from udccal.fitting.geometry.calibrated import CalibratedViews
from udccal.fitting.geometry.corners import BoardCorners
from udccal.fitting.geometry.data import BoardView, gather
from udccal.fitting.geometry.views import calibrate_views
from udccal.models.geometry import Geometry, mounting_rotation, project, unproject

SPEC = BoardSpec(columns=7, rows=5, square_mm=40.0, marker_mm=30.0)
SIZE = (320, 240)
CAMERA = Geometry(
    focal_px=np.array([300.0, 300.4]),
    principal_point_px=np.array([161.0, 118.0]),
    distortion=np.array([-0.08, 0.03, 4e-4, -3e-4, 0.0]),
    rotation_rad=np.zeros(3),
    pupil_mm=np.zeros(3),
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


@dataclass(frozen=True)
class Sight:
    """A camera behind a panel with boards before it, their corners where a perfect detector puts them.

    Attributes:
        camera: the truth, its rotation included.
        size: (columns, rows).
        spec: of all boards.
        poses: board to camera, a rotation vector and a translation each; the first is parallel to the panel.
        sigma_px: of each corner of each view.
        tilt_deg: of the camera; its roll and yaw are ``MOUNTED_DEG``.
    """

    camera: Geometry
    size: tuple[int, int]
    spec: BoardSpec
    poses: np.ndarray
    sigma_px: np.ndarray
    tilt_deg: float

    def corners_px(self) -> np.ndarray:
        """``views corners 2``, without noise."""
        points = board_points_mm(self.spec)
        with jax.enable_x64(True):
            return np.stack([np.asarray(project(self.camera, points @ _matrix(p).T + p[3:])) for p in self.poses])

    def seen(self) -> np.ndarray:
        """``views corners``: whether a corner is in the picture."""
        exact = self.corners_px()
        return ((exact > 2) & (exact < np.array(self.size) - 3)).all(axis=-1)

    def views(self, rng: np.random.Generator, parallel: int = 1) -> list[BoardView]:
        """With noise; corners outside the picture are not seen. ``sigma`` excludes the common scatter."""
        own = np.sqrt(np.maximum(self.sigma_px**2 - COMMON_PX**2, 0.0))
        found = []
        for k, (exact, inside) in enumerate(zip(self.corners_px(), self.seen(), strict=True)):
            seen = np.flatnonzero(inside)
            xy = exact[seen] + self.sigma_px[k, seen, None] * rng.standard_normal((len(seen), 2))
            corners = BoardCorners(seen, xy, own[k, seen])
            found.append(BoardView(f"geometry/view_{k}", self.spec, k < parallel, corners, 0.0))
        return found

    def pictures(self, board: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
        """Corners of a board whose points are elsewhere than described, with noise; NaN where they are not seen."""
        found, truth = [], Intrinsics.of_geometry(self.camera).vector
        for pose, inside, sigma in zip(self.poses, self.seen(), self.sigma_px, strict=True):
            there = Rotation.from_rotvec(pose[:3]).apply(board) + pose[3:]
            noise = sigma[:, None] * rng.standard_normal((len(board), 2))
            found.append(np.where(inside[:, None], projected(truth, there)[0] + noise, np.nan))
        return found


# Of all corners, beside their own noise.
COMMON_PX = 0.04
WIDE = (1024, 768)
WIDE_SPEC = BoardSpec(columns=9, rows=7, square_mm=60.0, marker_mm=45.0)
MOUNTED_DEG = (0.6, -0.4)
VISIBLE_BEND = np.array([-0.07, 0.035, 8e-4, -7e-4, 0.0])


def sight(
    seed: int = 0,
    views: int = 10,
    tilt_deg: float = 17.0,
    distortion: np.ndarray = VISIBLE_BEND,
    focal_px: tuple[float, float] = (870.0, 870.2),
    centre_px: tuple[float, float] = (515.0, 380.0),
    distance_mm: tuple[float, float] = (550.0, 900.0),
    spots: float = 0.22,
    lean_rad: float = 0.6,
    sigma_px: float = 0.1,
    quadrant: bool = False,
) -> Sight:
    """One parallel view, then boards that lean every way at spots all over the picture.

    ``spots`` is how far from the middle the boards are held, of the width; corners differ in sigma by a factor of 3.
    With ``quadrant`` the boards stay in the upper left of the picture.
    """
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        mounted = np.asarray(mounting_rotation(*np.deg2rad(np.array([tilt_deg, *MOUNTED_DEG]))))
    turn = cv2.Rodrigues(mounted)[0].ravel()
    camera = Geometry(np.array(focal_px), np.array(centre_px), distortion, turn, np.array([600.0, 190.0, -14.0]))
    middle = np.array([WIDE_SPEC.columns, WIDE_SPEC.rows, 0]) * WIDE_SPEC.square_mm / 2
    poses = []
    for k in range(views):
        lean = lean_rad * rng.uniform(-1, 1, 3)
        matrix = mounted.T if k == 0 else cv2.Rodrigues(lean)[0]
        away = rng.uniform(*distance_mm)
        angle = 2.4 * k
        place = spots * np.array([np.cos(angle), 0.75 * np.sin(angle)]) * (k > 0) * WIDE[0] / focal_px[0]
        if quadrant:
            place = 0.3 * place - np.array([0.25, 0.2])
        centre = np.array([*place, 1.0]) * away
        poses.append(np.concatenate([cv2.Rodrigues(matrix)[0].ravel(), centre - matrix @ middle]))
    corners = len(board_points_mm(WIDE_SPEC))
    sigma = sigma_px * rng.uniform(0.5, 1.5, (views, corners))
    return Sight(camera, WIDE, WIDE_SPEC, np.array(poses), np.maximum(sigma, COMMON_PX), tilt_deg)


def _matrix(pose: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.Rodrigues(np.ascontiguousarray(pose[:3]))[0])


def calibrated(
    board: Sequence[np.ndarray],
    image: Sequence[np.ndarray],
    size: tuple[int, int],
    start: Geometry | None = None,
    sigmas: Sequence[np.ndarray] | None = None,
    **options: Any,
) -> CalibratedViews:
    """Lens and poses of arrays."""
    return calibrate_views(gather(board, image, sigmas), size, start, **options)
