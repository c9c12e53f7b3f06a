"""Convert raw numbers to electrons, and find samples that are saturated or defective."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import ArrayLike, Bool, Float32, UInt16

from udccal.cfa import cfa_named
from udccal.models.noise import Noise

# A sample is an outlier when it differs from all its neighbours by this many sigma of temporal noise ...
_OUTLIER_SIGMA = 8.0
# ... and by this many times their range. A point of light seen through the panel stays below 4: its kernel is wide.
_OUTLIER_RATIO = 5.0
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=np.uint8)


def scalar(value: ArrayLike) -> float:
    """Return a term's parameter, a number or an array without dimensions, as a float."""
    return float(np.asarray(value))


def to_electrons(
    mosaic: UInt16[np.ndarray, "rows columns"], noise: Noise, exposure_s: float
) -> Float32[np.ndarray, "rows columns"]:
    """Return the signal in e-: (DN - black) / K minus the mean dark signal. Negative values stay."""
    scale = 1.0 / scalar(noise.K_DN_per_e)
    offset = scalar(noise.black_DN) * scale + scalar(noise.dark_current_e_per_s) * exposure_s
    return mosaic.astype(np.float32) * np.float32(scale) - np.float32(offset)


def saturated(
    mosaic: UInt16[np.ndarray, "rows columns"], noise: Noise, margin: float
) -> Bool[np.ndarray, "rows columns"]:
    """Return the samples within ``margin`` (a fraction of the range above black) of saturation."""
    top, black = scalar(noise.saturation_DN), scalar(noise.black_DN)
    return mosaic >= top - margin * (top - black)


def variance_e2(
    signal_e: Float32[np.ndarray, "rows columns"], noise: Noise, exposure_s: float
) -> Float32[np.ndarray, "rows columns"]:
    """Return the temporal variance of every sample in e-^2 (EMVA 1288, linear camera model).

    A measured dark current slightly below zero adds no noise.

    Args:
        signal_e: signal in e-, dark signal excluded, backscatter included.
        noise: the noise term.
        exposure_s: exposure time.
    """
    dark_e = scalar(noise.dark_current_e_per_s) * exposure_s
    quantisation = (scalar(noise.q_DN) / scalar(noise.K_DN_per_e)) ** 2 / 12.0
    floor = max(dark_e, 0.0) + scalar(noise.sigma_d_e) ** 2 + quantisation
    return np.maximum(signal_e, np.float32(0)) + np.float32(floor)


def without_defects(
    signal_e: Float32[np.ndarray, "rows columns"], noise: Noise, cfa: str
) -> Float32[np.ndarray, "rows columns"]:
    """Replace hot and dead samples by the median of their 3 x 3 neighbourhood of the same colour.

    A sample is defective when it lies outside the range of its eight neighbours of the same colour by more than 8 sigma
    of its temporal noise and by more than 5 times that range.
    """
    cleaned = signal_e.copy()
    floor = scalar(noise.sigma_d_e) ** 2
    for site in cfa_named(cfa).sites:
        plane = np.ascontiguousarray(signal_e[site.samples])
        high, low = cv2.dilate(plane, _NEIGHBOURS), cv2.erode(plane, _NEIGHBOURS)
        sigma = np.sqrt(np.maximum(high, 0.0) + floor)
        allowed = np.maximum(_OUTLIER_SIGMA * sigma, _OUTLIER_RATIO * (high - low))
        defective = (plane > high + allowed) | (plane < low - allowed)
        cleaned[site.samples] = np.where(defective, cv2.medianBlur(plane, 3), plane)
    return cleaned
