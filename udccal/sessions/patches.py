"""A frame looked at in patches of whole 2 x 2 cells, so that no colour of the pattern stands out."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt16

_SIDE_PX = 32
_FEWEST_ACROSS = 8


def patch_means(data: UInt16[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "down across"]:
    """Means over patches of 32 x 32, or smaller where there would be fewer than 8 of them to a side; what is left over
    at the right and below is not looked at."""
    side = _side(data)
    down, across = data.shape[0] // side, data.shape[1] // side
    if min(down, across) < 1:
        return np.zeros((0, 0), np.float32)
    whole = data[: down * side, : across * side]
    return cv2.resize(whole.astype(np.float32), (across, down), interpolation=cv2.INTER_AREA)


def brightest_patch_DN(data: UInt16[np.ndarray, "rows columns"]) -> float:
    """The highest median of any patch: light that falls on a part of the frame, and no hot pixel, raises it."""
    return float(_patch_medians(data).max())


def _patch_medians(data: UInt16[np.ndarray, "rows columns"]) -> Float64[np.ndarray, "down across"]:
    side = _side(data)
    down, across = data.shape[0] // side, data.shape[1] // side
    if min(down, across) < 1:
        return np.full((1, 1), float(np.median(data)))
    whole = data[: down * side, : across * side].reshape(down, side, across, side).swapaxes(1, 2)
    return np.median(whole.reshape(down, across, side * side), axis=2)


def _side(data: UInt16[np.ndarray, "rows columns"]) -> int:
    return max(2, min(_SIDE_PX, min(data.shape) // _FEWEST_ACROSS // 2 * 2))
