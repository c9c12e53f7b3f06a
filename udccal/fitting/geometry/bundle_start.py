"""Where a bundle starts: focal length from homographies (Zhang, 2000), poses from flat boards (Collins, 2014).

A flat board seen from afar looks almost the same in two poses, mirrored at the line of sight. Both are kept: the
second is tried again once the lens is known.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.geometry.bundle_points import MIN_POINTS, Points
from udccal.fitting.geometry.bundle_solve import Bundle

# Of the picture's larger side: distortion bends straight lines by less, a corner read as its neighbour's by more.
_OFF_HOMOGRAPHY = 0.005
# Focal lengths outside this range, in units of the larger side, are no lens that these models describe.
_SHORTEST, _LONGEST = 0.15, 30.0
_FLAT = 1e-6
# Across one board; its part of the picture is smaller than the whole.
_WIDER = 4.0


def starts(
    points: Points,
    size: tuple[int, int],
    given: Float[np.ndarray, "9"] | None,
    poses: Float[np.ndarray, "views 6"] | None,
) -> list[Bundle]:
    """Bundles to begin from: from what is given, from the views' vanishing points, else from a common lens."""
    found = []
    if given is not None:
        found.append(Bundle(given, poses if poses is not None else best_poses(points, given)[0]))
    focal = _focal_px(points, size)
    if focal is None:
        focal = float(max(size))
    centred = np.array([focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, 0, 0, 0, 0, 0])
    found.append(Bundle(centred, best_poses(points, centred)[0]))
    return found


def best_poses(
    points: Points, intrinsics: Float[np.ndarray, "9"]
) -> tuple[Float[np.ndarray, "views 6"], Float[np.ndarray, "views 6"]]:
    """The pose of each view that suits these intrinsics, and the one mirrored at the line of sight."""
    pairs = [_pose_pair(points, view, intrinsics) for view in range(len(points.names))]
    return np.array([first for first, _ in pairs]), np.array([second for _, second in pairs])


def facing(poses: Float[np.ndarray, "views 6"]) -> Float[np.ndarray, "views 6"]:
    """The same pictures with every board in front of the camera, and rotations of at most half a turn.

    Behind the camera, a flat board turned by half a turn about its normal projects to the same points.
    """
    turned = poses.copy()
    for pose in turned:
        matrix = cv2.Rodrigues(np.ascontiguousarray(pose[:3]))[0]
        if pose[5] < 0:
            matrix, pose[3:] = matrix @ np.diag([-1.0, -1.0, 1.0]), -pose[3:]
        pose[:3] = cv2.Rodrigues(matrix)[0].ravel()
    return turned


def _pose_pair(points: Points, view: int, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mine = (points.view == view) & points.used
    if mine.sum() < MIN_POINTS:
        mine = points.view == view
    board, image = points.board[mine], points.image[mine]
    good = _consistent(board, image)
    matrix = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1.0]])
    flat = np.linalg.svd(board - board.mean(axis=0), compute_uv=False)
    method = cv2.SOLVEPNP_IPPE if flat[2] <= _FLAT * flat[0] else cv2.SOLVEPNP_SQPNP
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(board[good], image[good], matrix, intrinsics[4:9], flags=method)
    except cv2.error:
        turns, shifts = (), ()
    found = [np.concatenate([t.ravel(), s.ravel()]) for t, s in zip(turns, shifts, strict=True)]
    found = [pose for pose in found if np.isfinite(pose).all()]
    if not found:
        found = [_ahead(board, image, matrix)]
    return found[0], found[-1]


def _ahead(board: np.ndarray, image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Facing the camera, at the distance and place that the points' spread says."""
    seen = max(float(np.linalg.norm(image - image.mean(axis=0))), 1e-9)
    distance = matrix[0, 0] * float(np.linalg.norm(board - board.mean(axis=0))) / seen
    middle = np.linalg.solve(matrix, np.append(image.mean(axis=0), 1.0)) * distance
    return np.concatenate([np.zeros(3), middle - board.mean(axis=0)])


def _consistent(board: np.ndarray, image: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Points that one homography puts near where they are; all, where there are too few to tell."""
    everything = np.ones(len(board), dtype=bool)
    if len(board) < 2 * MIN_POINTS:
        return everything
    limit = max(_OFF_HOMOGRAPHY * _WIDER * float(np.ptp(image, axis=0).max()), 1.0)
    _, inside = cv2.findHomography(board[:, :2], image, cv2.RANSAC, limit)
    good = everything if inside is None else inside.ravel().astype(bool)
    return good if good.sum() >= max(MIN_POINTS, len(board) // 3) else everything


def _focal_px(points: Points, size: tuple[int, int]) -> float | None:
    """One focal length for both axes with the centre in the middle; None where the views do not tell it."""
    middle, unit = (np.array(size) - 1) / 2, float(max(size))
    rows, right = [], []
    for view in range(len(points.names)):
        mine = points.view == view
        board, image = points.board[mine, :2], (points.image[mine] - middle) / unit
        matrix, _ = cv2.findHomography(board, image, cv2.RANSAC, _OFF_HOMOGRAPHY)
        if matrix is None or not np.isfinite(matrix).all():
            continue
        first, second = matrix[:, 0], matrix[:, 1]
        scale = np.sqrt(np.linalg.norm(first) * np.linalg.norm(second))
        if scale <= 0:
            continue
        first, second = first / scale, second / scale
        # Both columns are images of orthogonal directions of equal length.
        rows += [first[:2] @ second[:2], first[:2] @ first[:2] - second[:2] @ second[:2]]
        right += [-first[2] * second[2], second[2] ** 2 - first[2] ** 2]
    inverse = _slope(rows, right)
    if inverse <= 0:
        return None
    focal = 1 / np.sqrt(inverse)
    return float(focal * unit) if _SHORTEST <= focal <= _LONGEST else None


def _slope(rows: Sequence[float], right: Sequence[float]) -> float:
    x, y = np.array(rows), np.array(right)
    return float(x @ y / (x @ x)) if len(x) and x @ x > 0 else 0.0
