"""Convert raw numbers to electrons."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt16

from udccal.models.noise import Noise, dark_DN, linear_signal, scalar

# Part of the range above black: where a sample says less than its light was.
_SATURATION_MARGIN = 0.015


def to_electrons(
    mosaic: UInt16[np.ndarray, "rows columns"], noise: Noise, exposure_s: float
) -> Float32[np.ndarray, "rows columns"]:
    """Return the signal in e-: DN above dark, without the response's bend, over K. Negative values stay."""
    signal = above_dark_DN(mosaic, noise, exposure_s)
    signal *= np.float32(1 / scalar(noise.K_DN_per_e))
    return signal


def above_dark_DN(
    mosaic: UInt16[np.ndarray, "rows columns"], noise: Noise, exposure_s: float
) -> Float32[np.ndarray, "rows columns"]:
    """Return the signal above dark in DN, without the response's bend."""
    dark, bend = dark_DN(noise, exposure_s), scalar(noise.bend_per_DN)
    if bend == 0:
        return cv2.subtract(mosaic, dark, dtype=cv2.CV_32F)
    black = scalar(noise.black_DN)
    signal = linear_signal(cv2.subtract(mosaic, black, dtype=cv2.CV_32F), np.float32(bend))
    signal -= np.float32(dark - black)
    return np.asarray(signal)


def saturated(mosaic: UInt16[np.ndarray, "rows columns"], noise: Noise) -> Bool[np.ndarray, "rows columns"]:
    """Return the samples within 1.5 % of the range above black of saturation."""
    return mosaic >= least_saturated_DN(noise)


def least_saturated_DN(noise: Noise) -> float:
    """Return the value from which on a sample counts as saturated."""
    top, black = scalar(noise.saturation_DN), scalar(noise.black_DN)
    return top - _SATURATION_MARGIN * (top - black)


def least_saturated_e(noise: Noise, exposure_s: float) -> float:
    """Return the signal in e- from which on a sample counts as saturated."""
    black = scalar(noise.black_DN)
    linear = float(linear_signal(least_saturated_DN(noise) - black, scalar(noise.bend_per_DN)))
    return (linear - (dark_DN(noise, exposure_s) - black)) / scalar(noise.K_DN_per_e)


def variance_e2(
    signal_e: Float32[np.ndarray, "rows columns"], noise: Noise, exposure_s: float
) -> Float32[np.ndarray, "rows columns"]:
    """Return the temporal variance of every sample in e-^2 (EMVA 1288, linear camera model).

    Args:
        signal_e: signal in e-, dark signal excluded, backscatter included.
        noise: the noise term.
        exposure_s: exposure time.
    """
    variance = np.maximum(signal_e, np.float32(0))
    variance += np.float32(variance_floor_e2(noise, exposure_s))
    return variance


def variance_floor_e2(noise: Noise, exposure_s: float) -> float:
    """Return the variance of a sample without light in e-^2.

    A measured dark current slightly below zero adds no noise.
    """
    dark_e = scalar(noise.dark_current_e_per_s) * exposure_s
    quantisation = (scalar(noise.q_DN) / scalar(noise.K_DN_per_e)) ** 2 / 12.0
    return max(dark_e, 0.0) + scalar(noise.sigma_d_e) ** 2 + quantisation
