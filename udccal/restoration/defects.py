"""Defective samples of a frame, found and replaced.

A sample is defective when it lies outside the range of its eight neighbours of the same colour by more than 8 sigma of
its temporal noise and by more than 5 times that range. In eight bits whose steps are equal parts of the noise, few
samples lie so far outside the range. So all samples are looked at in eight bits, and those few in full.
"""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8, UInt16

from udccal.cfa import Cfa, cfa_named
from udccal.models.noise import Noise, dark_DN, scalar
from udccal.restoration.linear import to_electrons

OUTLIER_SIGMA: Final = 8.0
# A point of light seen through the panel stays below 4 times the range: its kernel is wide.
OUTLIER_RATIO: Final = 5.0
_NEIGHBOURS: Final = tuple((down, across) for down in (-1, 0, 1) for across in (-1, 0, 1) if down or across)

Places = tuple[Int[np.ndarray, " places"], Int[np.ndarray, " places"]]


def without_defects(
    mosaic: UInt16[np.ndarray, "rows columns"], noise: Noise, exposure_s: float, cfa: str, workers: int = 1
) -> UInt16[np.ndarray, "rows columns"]:
    """Replace hot and dead samples by the median of their 3 x 3 neighbourhood of the same colour.

    Args:
        mosaic: raw frame in DN.
        noise: the noise term.
        exposure_s: exposure time of the frame.
        cfa: name of the colour pattern.
        workers: threads.

    Returns:
        a frame of its own, or the mosaic itself where no sample is defective.
    """
    pattern, floor_e2, most_DN = cfa_named(cfa), scalar(noise.sigma_d_e) ** 2, int(mosaic.max())
    # Frames of a video differ in their largest sample; rounded up to few values, they share their codes.
    most_DN |= (1 << max(most_DN.bit_length() - 4, 0)) - 1
    codes = _codes(dark_DN(noise, exposure_s), scalar(noise.K_DN_per_e), floor_e2, most_DN)
    places = _suspects(mosaic, pattern, *codes, workers)
    if len(places[0]) == 0:
        return mosaic
    around = np.stack([mosaic[_mirrored(places, mosaic.shape, step, pattern)] for step in _NEIGHBOURS])
    at = mosaic[places]
    at_e, around_e = (to_electrons(each, noise, exposure_s) for each in (at[None], around))
    wrong = _is_defective(at_e[0], around_e, floor_e2)
    if not wrong.any():
        return mosaic
    mended = mosaic.copy()
    mended[places[0][wrong], places[1][wrong]] = np.median(np.vstack([at, around])[:, wrong], axis=0)
    return mended


@functools.lru_cache(maxsize=4)
def _codes(dark: float, K_DN_per_e: float, floor_e2: float, most_DN: int) -> tuple[UInt8[np.ndarray, "values"], int]:
    """Return the code of each value in DN, and by how many codes a defective sample differs at least.

    Codes are even steps of the square root of the variance, which is continued as a straight line below no light.
    """
    values_DN = np.arange(1 << 16)
    signal = (values_DN - dark) / K_DN_per_e
    light = np.maximum(signal, 0.0)
    least_e2 = max(floor_e2, 1 / K_DN_per_e)
    roots = np.sqrt(light + least_e2) + np.minimum(signal, 0.0) / (2 * np.sqrt(least_e2))
    scale = 255 / max(roots[most_DN] - roots[0], 1e-6)
    codes = np.clip(scale * (roots - roots[0]), 0, 255).astype(np.uint8)
    allowed_DN = K_DN_per_e * OUTLIER_SIGMA * np.sqrt(light + floor_e2)
    apart = 255
    for bound_DN in (np.floor(values_DN + allowed_DN), np.ceil(values_DN - allowed_DN)):
        possible = (values_DN <= most_DN) & (bound_DN >= 0) & (bound_DN <= most_DN)
        steps = codes[bound_DN[possible].astype(int)].astype(int) - codes[possible]
        apart = min(apart, int(np.abs(steps).min(initial=255)))
    return codes, apart


def _suspects(
    mosaic: UInt16[np.ndarray, "rows columns"],
    pattern: Cfa,
    codes: UInt8[np.ndarray, "values"],
    apart: int,
    workers: int,
) -> Places:
    """Return the samples that differ by ``apart`` codes or more from the range of their neighbours."""
    rows = len(mosaic)
    step = -(-rows // workers)

    def within(first: int) -> Places:
        """Look at some rows, and at those of their neighbours."""
        begin, end = max(first - pattern.rows, 0), min(first + step + pattern.rows, rows)
        outside = _outside(mosaic[begin:end], pattern, codes, apart)[first - begin : first - begin + step]
        found = cv2.findNonZero(outside)  # ten times as quick as numpy's; None where there is none
        x, y = np.empty((2, 0), dtype=int) if found is None else found.reshape(-1, 2).T.astype(int)
        return y + first, x

    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(within, range(0, rows, step)))
    return np.concatenate([y for y, _ in parts]), np.concatenate([x for _, x in parts])


def _outside(
    mosaic: UInt16[np.ndarray, "rows columns"], pattern: Cfa, codes: UInt8[np.ndarray, "values"], apart: int
) -> UInt8[np.ndarray, "rows columns"]:
    """Return where a sample lies outside the range of its neighbours, as a number above 0."""
    code = cv2.LUT(mosaic, codes)
    ring = np.zeros((2 * pattern.rows + 1, 2 * pattern.columns + 1), dtype=np.uint8)
    ring[:: pattern.rows, :: pattern.columns] = 1
    ring[pattern.rows, pattern.columns] = 0
    outside = cv2.subtract(code, cv2.dilate(code, ring))
    outside = cv2.max(outside, cv2.subtract(cv2.erode(code, ring), code))
    return np.asarray(cv2.compare(outside, apart, cv2.CMP_GE))


def _is_defective(
    at_e: Float32[np.ndarray, " places"], around_e: Float32[np.ndarray, "8 places"], floor_e2: float
) -> Bool[np.ndarray, " places"]:
    high, low = around_e.max(axis=0), around_e.min(axis=0)
    sigma = np.sqrt(np.maximum(high, 0.0) + np.float32(floor_e2))
    allowed = np.maximum(OUTLIER_SIGMA * sigma, OUTLIER_RATIO * (high - low))
    return (at_e > high + allowed) | (at_e < low - allowed)


def _mirrored(places: Places, shape: tuple[int, ...], step: tuple[int, int], pattern: Cfa) -> Places:
    """Return the places of neighbours of the same site; beyond the border, those mirrored at it."""
    y, x = (
        _mirrored_along(at, most, by, cell)
        for at, most, by, cell in zip(places, shape, step, (pattern.rows, pattern.columns), strict=True)
    )
    return y, x


def _mirrored_along(at: Int[np.ndarray, " places"], most: int, by: int, cell: int) -> Int[np.ndarray, " places"]:
    site = at % cell
    last = (most - 1 - site) // cell
    return np.abs(last - np.abs(last - (at // cell + by))) * cell + site
