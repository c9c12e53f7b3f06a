"""OpenCV's ChArUco board of a description, and the places of its inner corners."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from udccal.arrangements import BoardSpec
from udccal.errors import FitError


def charuco_board(spec: BoardSpec) -> cv2.aruco.CharucoBoard:
    """OpenCV's board of a description; a dictionary that OpenCV lacks is a ``FitError``."""
    if not (spec.dictionary.startswith("DICT_") and hasattr(cv2.aruco, spec.dictionary)):
        raise FitError(
            f"Expected the name of a dictionary of OpenCV such as DICT_5X5_1000, found '{spec.dictionary}'. "
            "Correct the board's description."
        )
    whole = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    # Only the board's own markers, every second square: a search among all thousand takes ten times as long.
    own = whole.bytesList[: spec.columns * spec.rows // 2]
    dictionary = cv2.aruco.Dictionary(own, whole.markerSize, whole.maxCorrectionBits)
    return cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_mm, spec.marker_mm, dictionary)


def board_points_mm(spec: BoardSpec) -> Float[np.ndarray, "corners 3"]:
    """Inner corners (x, y, 0) of a board in mm, in the order of their numbers; errors as for ``charuco_board``."""
    return np.asarray(charuco_board(spec).getChessboardCorners(), dtype=np.float64).reshape(-1, 3)
