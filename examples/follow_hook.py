"""A hook for `udccal run --hook examples.follow_hook:overlay`: a cross stays on what was in the middle at first."""

from typing import final

import cv2
import numpy as np


@final
class Follower:
    """Follows the picture's movement from frame to frame, on a small grey copy of it."""

    def __init__(self) -> None:
        self._before: np.ndarray | None = None
        self._place = np.zeros(2)

    def overlay(self, picture: np.ndarray, frame_id: int) -> np.ndarray:
        scale = 160 / picture.shape[1]
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
        if self._before is None:
            self._place = np.array(picture.shape[1::-1]) / 2
        else:
            moved, _ = cv2.phaseCorrelate(self._before, grey)
            self._place += np.array(moved) / scale
        self._before = grey
        x, y = (round(float(v)) for v in self._place)
        return cv2.drawMarker(picture, (x, y), (255, 0, 0), cv2.MARKER_CROSS, max(picture.shape[1] // 16, 8), 2)


overlay = Follower().overlay
