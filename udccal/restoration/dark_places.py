"""What is known of places that are darker than the error of the light subtracted there.

Of backscatter, the calibration knows all but a few per mille. Where the scene is as dark as that, what is left of a
colour may be anything, negative too: a display shows black, and patches of saturated green or blue. Two things are
known beforehand. Light is not negative. And a colour deviates from grey by a fraction of its brightness, by and large.
So brightness becomes its posterior mean under a flat prior above 0, and a deviation keeps the part of its variance that
the error does not explain. The error is smooth, as the panel's light is; so is the correction.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32
from scipy.special import erfcx

from udccal.restoration.scene_prior import COLOURFUL

# Pixels across, of which the smooth picture has one.
STEP = 16
# Where no deviation is wrong by more than this part, nothing is changed.
NEGLIGIBLE = 0.01
LEAST_E = 1e-6
# Every n-th row is looked at first.
_SPARSE = 4


def plausible(
    picture_e: Float32[np.ndarray, "rows columns 3"], error_e: Float32[np.ndarray, "rows columns"]
) -> Float32[np.ndarray, "rows columns 3"]:
    """Correct brightness and colour of dark places; return the picture itself where there are none.

    Args:
        picture_e: restored picture in e-.
        error_e: sigma of the light that was subtracted, in e-.
    """
    rows, columns = error_e.shape
    size = max(columns // STEP, 1), max(rows // STEP, 1)
    # Most pictures are bright everywhere, which some of their rows tell.
    if float(_doubt(*_smooth(picture_e[::_SPARSE], error_e[::_SPARSE], size)).max()) < NEGLIGIBLE / 2:
        return picture_e
    smooth, sigma = _smooth(picture_e, error_e, size)
    doubt = _doubt(smooth, sigma)
    if float(doubt.max()) < NEGLIGIBLE:
        return picture_e
    # The errors of three colours average.
    grey = smooth.mean(axis=2, keepdims=True)
    change = doubt * (grey - smooth) + _lift(grey, sigma / np.float32(np.sqrt(3)))
    return picture_e + cv2.resize(change.astype(np.float32), (columns, rows), interpolation=cv2.INTER_LINEAR)


def _smooth(
    picture_e: Float32[np.ndarray, "rows columns 3"],
    error_e: Float32[np.ndarray, "rows columns"],
    size: tuple[int, int],
) -> tuple[Float32[np.ndarray, "down across 3"], Float32[np.ndarray, "down across 1"]]:
    """Return the smooth picture, of ``size`` (columns, rows), and sigma of its error."""
    small, error = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (picture_e, error_e))
    return cv2.blur(small, (3, 3)), np.maximum(error, np.float32(LEAST_E))[..., None]


def _doubt(
    smooth: Float32[np.ndarray, "down across 3"], sigma: Float32[np.ndarray, "down across 1"]
) -> Float32[np.ndarray, "down across 1"]:
    """Return the part of a colour's variance that the error explains."""
    grey = smooth.mean(axis=2, keepdims=True)
    return sigma**2 / (COLOURFUL * np.maximum(grey, np.float32(0)) ** 2 + sigma**2)


def _lift(value: Float32[np.ndarray, "..."], sigma: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Return the posterior mean less ``value`` of what is not negative (the truncated normal distribution's mean)."""
    # The normal density over its integral, by the scaled error function: both underflow far below 0.
    return sigma * np.float32(np.sqrt(2 / np.pi)) / erfcx(value / (-np.float32(np.sqrt(2)) * sigma))
