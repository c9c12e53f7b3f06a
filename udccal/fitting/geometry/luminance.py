"""Grey picture of a black-and-white subject from a mosaic, with the variance of what went into it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.ndimage import convolve1d

from udccal.models.noise import Noise, variance_e

# Along one axis; it gives each of the four sites of the pattern one quarter at every pixel and is symmetric.
BINOMIAL = np.array([0.25, 0.5, 0.25])


@final
@dataclass(frozen=True)
class Luminance:
    """``grey`` has been filtered; ``variance`` is of the samples before that, brought to the same mean as they were."""

    grey: Float[np.ndarray, "rows columns"]
    variance: Float[np.ndarray, "rows columns"]


def luminance(mosaic: Float[np.ndarray, "rows columns"], variance: Float[np.ndarray, "rows columns"]) -> Luminance:
    """Grey picture on the mosaic's own pixels; ``mosaic`` is black-free, ``variance`` that of its samples.

    The four sites of the pattern are brought to one mean and averaged with the filter (1 2 1) x (1 2 1) / 16: nothing
    moves, and no pattern is left.
    """
    grey, spread = np.asarray(mosaic, dtype=np.float64).copy(), np.asarray(variance, dtype=np.float64).copy()
    total = max(float(grey.mean()), 1e-12)
    for row in (0, 1):
        for column in (0, 1):
            site = (slice(row, None, 2), slice(column, None, 2))
            gain = total / max(float(grey[site].mean()), 1e-12)
            grey[site] *= gain
            spread[site] *= gain**2
    return Luminance(filtered(grey), spread)


def filtered(picture: Float[np.ndarray, "*stack rows columns"]) -> Float[np.ndarray, "*stack rows columns"]:
    """With the binomial filter, symmetric at the borders."""
    return np.asarray(convolve1d(convolve1d(picture, BINOMIAL, axis=-2), BINOMIAL, axis=-1), dtype=np.float64)


def temporal_variance_DN2(
    noise: Noise, light_DN: Float[np.ndarray, "rows columns"], exposure_s: float
) -> Float[np.ndarray, "rows columns"]:
    """Variance in DN^2 of single samples of that mean light (EMVA 1288's photon transfer)."""
    gain = float(np.asarray(noise.K_DN_per_e))
    return gain**2 * np.asarray(variance_e(noise, light_DN / gain, np.float64(exposure_s)), dtype=np.float64)
