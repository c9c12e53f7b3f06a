"""Compares the board corners of a session with the fitted geometry: numbers for the report's coverage picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from udccal.board.charuco import board_points_mm
from udccal.fitting.geometry.bundle import Intrinsics
from udccal.fitting.geometry.data import BoardView
from udccal.models.geometry import Geometry


@dataclass(frozen=True)
class BoardEvidence:
    """Every corner found, and its distance from the projection by the fitted lens and the best pose of its board."""

    corners_px: Float[np.ndarray, "n 2"]
    residuals_px: Float[np.ndarray, "n 2"]
    views: int


def board_evidence(boards: Sequence[BoardView], geometry: Geometry) -> BoardEvidence | None:
    """Return corners and residuals in px of all usable board views; None when there are none."""
    views = [view for view in boards if view.usable()]
    if not views:
        return None
    residuals = [_residuals(view, geometry) for view in views]
    return BoardEvidence(np.concatenate([v.corners.xy for v in views]), np.concatenate(residuals), len(views))


def _residuals(view: BoardView, geometry: Geometry) -> Float[np.ndarray, "n 2"]:
    """Return found minus projected corners in px, with the pose that fits this view best."""
    lens = Intrinsics.of_geometry(geometry).opencv
    points_mm = board_points_mm(view.spec)[view.corners.ids]
    _, rotation, translation = cv2.solvePnP(points_mm, view.corners.xy, *lens)
    projected, _ = cv2.projectPoints(points_mm, rotation, translation, *lens)
    return view.corners.xy - projected.reshape(-1, 2)
