"""The board as black rectangles, so that a printer gets shapes and not pixels."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from udccal.arrangements import BoardSpec
from udccal.simulation.board import opencv_board


def black_rectangles_mm(spec: BoardSpec) -> Float[np.ndarray, "rectangles 4"]:
    """Return x, y, width and height of all black areas, in board coordinates: from its outer top left corner.

    They touch but do not overlap: the black squares, and for each marker the runs of black cells in its rows.
    """
    board = opencv_board(spec)
    marker_corners, numbers = board.getObjPoints(), np.ravel(board.getIds())
    squares = [
        (column * spec.square_mm, row * spec.square_mm, spec.square_mm, spec.square_mm)
        for row in range(spec.rows)
        for column in range(spec.columns)
        if (row + column) % 2 == 0
    ]
    runs = []
    for number, corners in zip(numbers, marker_corners, strict=True):
        runs += _marker_runs(board.getDictionary(), int(number), corners[0][:2], spec.marker_mm)
    return np.array(squares + runs)


def _marker_runs(
    dictionary: cv2.aruco.Dictionary, number: int, corner_mm: Float[np.ndarray, "2"], side_mm: float
) -> list[tuple[float, float, float, float]]:
    cells = dictionary.markerSize + 2
    black = cv2.aruco.generateImageMarker(dictionary, number, cells) == 0
    cell = side_mm / cells
    found = []
    for row in range(cells):
        changes = np.flatnonzero(np.diff(np.concatenate([[False], black[row], [False]])))
        for start, end in changes.reshape(-1, 2):
            found.append((corner_mm[0] + start * cell, corner_mm[1] + row * cell, (end - start) * cell, cell))
    return [(float(x), float(y), float(w), float(h)) for x, y, w, h in found]
