"""A pair of dark frames as the joint histogram of the two codes that each pixel gave."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt16

_MOST_CODES = 160
# Samples of a strip, which stays in the processor's cache.
_STRIP = 1 << 18


@dataclass(frozen=True)
class DarkPair:
    """A pair of dark frames reduced to the joint histogram of the two codes of each pixel.

    The outermost edges are infinite where the codes stop there (at 0, or at the converter's end).
    """

    exposure_s: float
    edges_DN: Float[np.ndarray, " codes_plus_1"]
    counts: Int[np.ndarray, "codes codes"]
    outside: int
    rows: int


def dark_pair(
    first: UInt16[np.ndarray, "rows columns"],
    second: UInt16[np.ndarray, "rows columns"],
    exposure_s: float,
    q_DN: int = 1,
    top_code: int = 65535,
) -> DarkPair:
    """Joint histogram over a window of codes around the median; codes beyond it are counted as outside."""
    sample = first[:: max(1, first.size // 65536)]
    low, middle, high = np.percentile(sample, [2.0, 50.0, 98.0])
    # 98th minus 2nd percentile is 4.1 sigma; 1.9 times that each side is about 7.8 sigma.
    half = int(np.ceil(1.9 * (high - low) / q_DN)) + 4
    group = max(1, int(np.ceil((2 * half + 1) / _MOST_CODES)))
    start = max(round(middle / q_DN) - half, 0)
    codes = min((round(middle / q_DN) + half - start) // group, (top_code // q_DN - start) // group) + 1
    # One more group takes all that lies outside the window, codes below it included: they wrap around.
    side = codes + 1
    joint = np.zeros(side * side, np.int64)
    height = max(_STRIP // first.shape[1], 1)
    for top in range(0, first.shape[0], height):
        index, other = (_code_groups(f[top : top + height], start, group, q_DN, codes) for f in (first, second))
        index *= np.uint16(side)
        index += other
        joint += cv2.calcHist([index], [0], None, [joint.size], [0, joint.size]).ravel().astype(np.int64)
    counts = joint.reshape(side, side)[:codes, :codes]
    edges = (start + group * np.arange(codes + 1) - 0.5) * q_DN
    edges[0] = -np.inf if start == 0 else edges[0]
    edges[-1] = np.inf if edges[-1] >= top_code else edges[-1]
    return DarkPair(exposure_s, edges.astype(np.float64), counts, int(first.size - counts.sum()), first.shape[0])


def _code_groups(
    frame: UInt16[np.ndarray, "rows columns"], start: int, group: int, q_DN: int, codes: int
) -> UInt16[np.ndarray, "rows columns"]:
    shifted = frame // np.uint16(q_DN) if q_DN > 1 else frame
    below = shifted < np.uint16(start) if group > 1 else None
    shifted = shifted - np.uint16(start)
    if group > 1:
        shifted //= np.uint16(group)
        # A wrapped code may come to lie inside once it is divided.
        shifted[below] = codes
    return np.minimum(shifted, np.uint16(codes), out=shifted)


def centres_DN(pair: DarkPair) -> Float[np.ndarray, " codes"]:
    """Middle of each group of codes; of a cut-off end, where its neighbours would put it."""
    edges = pair.edges_DN
    step = float(np.median(np.diff(edges[np.isfinite(edges)]))) if np.isfinite(edges).sum() > 1 else 1.0
    middle = 0.5 * (edges[1:] + edges[:-1])
    if np.isinf(edges[0]):
        middle[0] = edges[1] - 0.5 * step
    if np.isinf(edges[-1]):
        middle[-1] = edges[-2] + 0.5 * step
    return middle
