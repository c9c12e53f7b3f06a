"""Inner corners of a ChArUco board in a raw mosaic, to a few hundredths of a pixel.

The detector of OpenCV names the corners; each is then placed by fitting a blurred saddle to the samples around it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from udccal.arrangements import BoardSpec
from udccal.errors import FitError
from udccal.fitting.geometry.luminance import Luminance
from udccal.fitting.geometry.saddles import fit_saddles

# Fewer corners than this do not hold a pose and say little about the lens.
MIN_CORNERS = 6
# A corner keeps this much distance (in units of the square) from the markers inside the white squares.
_MARKER_MARGIN = 0.9
_MAX_RADIUS_SQUARES = 0.4


@dataclass(frozen=True)
class BoardCorners:
    """Corners found: their numbers on the board, where they are in sensor pixels, and one sigma in px of that by noise.

    What a board's print and the picture's blur add to it, the bundle tells from how corners scatter.
    """

    ids: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, " n"]


def charuco_board(spec: BoardSpec) -> cv2.aruco.CharucoBoard:
    """OpenCV's board of that description.

    Raises:
        FitError: when OpenCV has no dictionary of that name.
    """
    if not (spec.dictionary.startswith("DICT_") and hasattr(cv2.aruco, spec.dictionary)):
        raise FitError(
            f"Expected the name of a dictionary of OpenCV such as DICT_5X5_1000, found '{spec.dictionary}'. "
            "Correct the board's description."
        )
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    return cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_mm, spec.marker_mm, dictionary)


def board_points_mm(spec: BoardSpec) -> Float[np.ndarray, "corners 3"]:
    """Inner corners in board coordinates, in the order of their numbers."""
    return np.asarray(charuco_board(spec).getChessboardCorners(), dtype=np.float64).reshape(-1, 3)


def detect_corners(picture: Luminance, spec: BoardSpec) -> BoardCorners:
    """Find a board's inner corners in a grey picture (any linear unit); none found gives empty arrays.

    Raises:
        FitError: when the board's dictionary is unknown.
    """
    ids, rough = _detect(picture.grey, spec)
    if len(ids) < MIN_CORNERS:
        return BoardCorners(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros(0))
    axis_x, axis_y = _axes_px(board_points_mm(spec)[ids, :2], rough, spec.square_mm)
    margin = _MARKER_MARGIN * np.sqrt(2.0) * (spec.square_mm - spec.marker_mm) / (2.0 * spec.square_mm)
    side = np.minimum(np.linalg.norm(axis_x, axis=1), np.linalg.norm(axis_y, axis=1))
    radius = np.clip(min(margin, _MAX_RADIUS_SQUARES) * side, 4.0, 25.0)
    saddles = fit_saddles(picture, rough, np.stack([axis_x, axis_y], axis=1), radius)
    good = saddles.ok
    return BoardCorners(ids[good], saddles.xy[good], saddles.sigma[good])


def _detect(
    grey: Float[np.ndarray, "rows columns"], spec: BoardSpec
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """OpenCV's detection, on the picture and, for strong blur, on one of half its size; the richer answer."""
    low, high = np.percentile(grey, [0.5, 99.5])
    scaled = np.clip((grey - low) / max(high - low, 1e-12), 0.0, 1.0)
    picture = np.round(255.0 * scaled).astype(np.uint8)
    detector = cv2.aruco.CharucoDetector(charuco_board(spec))
    best = (np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
    inner = (spec.columns - 1) * (spec.rows - 1)
    for halvings in (0, 1):
        if len(best[0]) == inner:
            break
        shrink = 2**halvings
        small = picture if halvings == 0 else cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        corners, ids, _, _ = detector.detectBoard(small)
        if ids is not None and len(ids) > len(best[0]):
            xy = (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) * shrink - 0.5
            best = (np.asarray(ids, dtype=np.int64).reshape(-1), xy)
    return best


def _axes_px(
    board: Float[np.ndarray, "n 2"], image: Float[np.ndarray, "n 2"], square_mm: float
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """How one square's side to the right and one side down look in the picture at each corner."""
    homography, _ = cv2.findHomography(board, image, cv2.RANSAC, 5.0)
    if homography is None:
        homography = np.eye(3)

    def seen(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return cv2.perspectiveTransform(points.reshape(-1, 1, 2), homography).reshape(-1, 2)

    half = square_mm / 2
    right, down = np.array([half, 0.0]), np.array([0.0, half])
    return seen(board + right) - seen(board - right), seen(board + down) - seen(board - down)
