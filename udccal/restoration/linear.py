"""Convert raw numbers to electrons, and replace samples that are defective."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import ArrayLike, Bool, Float32, UInt16

from udccal.cfa import cfa_named
from udccal.models.noise import Noise

# Part of the range above black: where a sample says less than its light was.
_SATURATION_MARGIN = 0.015
# A sample is an outlier when it differs from all its neighbours by this many sigma of temporal noise ...
_OUTLIER_SIGMA = 8.0
# ... and by this many times their range. A point of light seen through the panel stays below 4: its kernel is wide.
_OUTLIER_RATIO = 5.0
_NEIGHBOURS = tuple((down, across) for down in (-1, 0, 1) for across in (-1, 0, 1) if down or across)


def scalar(value: ArrayLike) -> float:
    """Return a term's parameter, a number or an array without dimensions, as a float."""
    return float(np.asarray(value))


def dark_DN(noise: Noise, exposure_s: float) -> float:
    """Return what a sample reads without light: black level and mean dark signal."""
    return scalar(noise.black_DN) + scalar(noise.K_DN_per_e) * scalar(noise.dark_current_e_per_s) * exposure_s


def to_electrons(
    mosaic: UInt16[np.ndarray, "rows columns"], noise: Noise, exposure_s: float
) -> Float32[np.ndarray, "rows columns"]:
    """Return the signal in e-: DN above dark over K. Negative values stay."""
    return (mosaic.astype(np.float32) - np.float32(dark_DN(noise, exposure_s))) / np.float32(scalar(noise.K_DN_per_e))


def saturated(mosaic: UInt16[np.ndarray, "rows columns"], noise: Noise) -> Bool[np.ndarray, "rows columns"]:
    """Return the samples within 1.5 % of the range above black of saturation."""
    top, black = scalar(noise.saturation_DN), scalar(noise.black_DN)
    return mosaic >= top - _SATURATION_MARGIN * (top - black)


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
    floor = np.float32(scalar(noise.sigma_d_e) ** 2)
    for site in cfa_named(cfa).sites:
        plane = np.ascontiguousarray(signal_e[site.samples])
        median = cv2.medianBlur(plane, 3)
        # Few samples are this far from their median, and no defective one is nearer.
        away = plane - median
        least = np.maximum(median, np.float32(0)) + floor
        places = np.nonzero(away * away > np.float32(_OUTLIER_SIGMA**2) * least)
        at = tuple(index[_is_defective(plane, places, floor)] for index in places)
        plane[at] = median[at]
        cleaned[site.samples] = plane
    return cleaned


def _is_defective(
    plane: Float32[np.ndarray, "rows columns"], places: tuple[np.ndarray, ...], floor_e2: np.float32
) -> Bool[np.ndarray, " places"]:
    neighbours = np.stack([plane[_mirrored(places, plane.shape, step)] for step in _NEIGHBOURS])
    high, low = neighbours.max(axis=0), neighbours.min(axis=0)
    sigma = np.sqrt(np.maximum(high, 0.0) + floor_e2)
    allowed = np.maximum(_OUTLIER_SIGMA * sigma, _OUTLIER_RATIO * (high - low))
    return (plane[places] > high + allowed) | (plane[places] < low - allowed)


def _mirrored(places: tuple[np.ndarray, ...], shape: tuple[int, ...], step: tuple[int, int]) -> tuple[np.ndarray, ...]:
    """Return the indices of neighbours; beyond the border, those mirrored at it."""
    steps = zip(places, step, shape, strict=True)
    return tuple(np.abs((most - 1) - np.abs((most - 1) - (at + by))) % most for at, by, most in steps)
