"""Means and medians of a frame over patches of whole 2 x 2 cells, in which all colours of the pattern count equally."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt16

_SIDE_PX = 32
_FEWEST_ACROSS = 8


def patch_means(data: UInt16[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "down across"]:
    """Return means over patches of 32 x 32 samples, or smaller ones where a side would have fewer than 8 patches.

    Samples left over at the right and at the bottom are ignored.
    """
    side = _side(data)
    down, across = data.shape[0] // side, data.shape[1] // side
    if min(down, across) < 1:
        return np.zeros((0, 0), np.float32)
    whole = data[: down * side, : across * side]
    return cv2.resize(whole.astype(np.float32), (across, down), interpolation=cv2.INTER_AREA)


def brightest_patch_DN(data: UInt16[np.ndarray, "rows columns"]) -> float:
    """Return the highest median of a patch of ``data`` in DN; light on part of the frame raises it, hot pixels not."""
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
