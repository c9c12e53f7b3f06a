"""What a view of a board adds to what is known of a lens: the gain in the log-determinant of Fisher information."""

from __future__ import annotations

from typing import final

import cv2
import numpy as np
from jaxtyping import Float

from procedures.aiming import nominal_pixels
from procedures.readings import CornersSeen
from udccal.arrangements import Board, BoardSpec
from udccal.rig import RigDescription

_CORNER_PX = 0.2  # sigma of a corner
_DISTORTION = (0.3, 0.3, 0.01, 0.01, 0.3)  # prior sigmas of k1, k2, p1, p2, k3
_FEWEST = 6
_TINY = 1e-9


@final
class LensInformation:
    """Information on focal lengths, centre and distortion of a nominal lens, without the poses of the boards."""

    def __init__(self, rig: RigDescription) -> None:
        self._rig = rig
        centre = ((rig.camera.columns - 1) / 2, (rig.camera.rows - 1) / 2)
        self._matrix = np.array([[rig.focal_px, 0, centre[0]], [0, rig.focal_px, centre[1]], [0, 0, 1.0]])
        focal = 0.02 * rig.focal_px
        prior = np.array([focal, focal, 0.02 * rig.camera.columns, 0.02 * rig.camera.columns, *_DISTORTION])
        self._known = np.diag(prior**-2.0)

    def of_corners(self, seen: CornersSeen, spec: BoardSpec) -> Float[np.ndarray, "9 9"]:
        """Return the information of corners that are seen, at the pose that fits them best."""
        places = _corners_mm(spec)[seen.numbers]
        if len(places) < _FEWEST:
            return np.zeros_like(self._known)
        found, turn, shift = cv2.solvePnP(places, seen.points_px, self._matrix, None)
        return self._at(places, turn, shift) if found else np.zeros_like(self._known)

    def of_board(self, board: Board) -> Float[np.ndarray, "9 9"]:
        """Return the information of a board held exactly as asked."""
        spec = board.spec
        turn = cv2.Rodrigues(np.array(board.rotation_vector))[0]
        points = nominal_pixels(self._rig, _corners_mm(spec) @ turn.T + np.array(board.translation_mm))
        camera = self._rig.camera
        inside = ((points >= 0) & (points <= [camera.columns - 1, camera.rows - 1])).all(axis=1)
        return self.of_corners(CornersSeen(np.flatnonzero(inside), points[inside]), spec)

    def gain(self, information: Float[np.ndarray, "9 9"]) -> float:
        """Return half the gain in the log-determinant that further information gives."""
        both, before = (np.linalg.slogdet(matrix)[1] for matrix in (self._known + information, self._known))
        return float(both - before) / 2

    def add(self, information: Float[np.ndarray, "9 9"]) -> None:
        """Count information as known."""
        self._known = self._known + information

    def _at(
        self, places: Float[np.ndarray, "n 3"], turn: Float[np.ndarray, "3 1"], shift: Float[np.ndarray, "3 1"]
    ) -> Float[np.ndarray, "9 9"]:
        """Return the Schur complement of the pose: what the corners say once the pose has been fitted too."""
        by_all = cv2.projectPoints(places, turn, shift, self._matrix, np.zeros(5))[1] / _CORNER_PX
        pose, lens = by_all[:, :6], by_all[:, 6:]
        of_pose, crossed = pose.T @ pose, lens.T @ pose
        scale = np.sqrt(np.diag(of_pose)) + _TINY  # rad and mm differ by orders
        solved = np.linalg.solve(of_pose / np.outer(scale, scale) + _TINY * np.eye(6), (crossed / scale).T)
        return np.asarray(lens.T @ lens - (crossed / scale) @ solved)


def _corners_mm(spec: BoardSpec) -> Float[np.ndarray, "n 3"]:
    """Return the inner corners on the board, numbered along its rows as OpenCV does."""
    x, y = np.meshgrid(np.arange(1, spec.columns), np.arange(1, spec.rows))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * spec.square_mm
