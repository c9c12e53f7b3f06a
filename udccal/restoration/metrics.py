"""How close a restored picture is to the truth, in display-encoded values."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from udccal.restoration.tone import display_exposure, encode_srgb

__all__ = ["display_exposure", "encode_srgb", "least_squares_gain", "psnr", "ssim"]

_WINDOW, _SIGMA, _K1, _K2 = (11, 11), 1.5, 0.01, 0.03


def psnr(picture: Float[np.ndarray, "*shape"], truth: Float[np.ndarray, "*shape"]) -> float:
    """Return the peak signal-to-noise ratio in dB, peak 1, over all samples.

    Args:
        picture: display-encoded values from 0 to 1.
        truth: what they should be.

    Returns:
        the ratio; 120 for identical pictures.
    """
    error = float(np.mean((picture.astype(np.float64) - truth.astype(np.float64)) ** 2))
    return -10.0 * float(np.log10(max(error, 1e-12)))


def ssim(picture: Float[np.ndarray, "rows columns 3"], truth: Float[np.ndarray, "rows columns 3"]) -> float:
    """Return the mean structural similarity over an 11 x 11 Gaussian window, averaged over channels.

    Source: Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004.

    Args:
        picture: display-encoded values from 0 to 1.
        truth: what they should be.
    """
    a, b = picture.astype(np.float64), truth.astype(np.float64)
    mean_a, mean_b = _local_mean(a), _local_mean(b)
    variance_a = _local_mean(a * a) - mean_a**2
    variance_b = _local_mean(b * b) - mean_b**2
    covariance = _local_mean(a * b) - mean_a * mean_b
    c1, c2 = _K1**2, _K2**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * covariance + c2) / (variance_a + variance_b + c2)
    return float(np.mean(luminance * structure))


def least_squares_gain(
    picture: Float[np.ndarray, "rows columns 3"], truth: Float[np.ndarray, "rows columns 3"]
) -> Float[np.ndarray, "3"]:
    """Return the gain per channel that brings a picture closest to the truth, by least squares.

    Args:
        picture: linear light.
        truth: what it should be.
    """
    product = np.einsum("ijc,ijc->c", picture, truth, dtype=np.float64)
    power = np.einsum("ijc,ijc->c", picture, picture, dtype=np.float64)
    return product / np.maximum(power, 1e-30)


def _local_mean(picture: Float[np.ndarray, "rows columns 3"]) -> Float[np.ndarray, "rows columns 3"]:
    return cv2.GaussianBlur(picture, _WINDOW, _SIGMA, borderType=cv2.BORDER_REFLECT_101)
