"""The prior of a scene: the power spectrum of pictures, how colours agree, and the strengths that it may have."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

# Of the prior, fitted on photographs of two magnifications: the exponent of its power spectrum, the frequency in
# cycles/px below which it is flat, and the variance of a colour's deviation from grey relative to that of the grey.
_EXPONENT, _FLAT_BELOW, COLOURFUL = 3.0, 0.003, 0.2
# The prior's covariance of two colours relative to the variance of grey.
COLOURS = COLOURFUL * np.eye(3) + 1 - COLOURFUL / 3
# Of the variance that colours share, over that of each one's deviation.
COMMON = (1 - COLOURFUL / 3) / COLOURFUL
# Strengths of the prior in units of the noise: RMS difference of neighbours over the sigma of a sample, squared.
STRENGTHS = np.exp2(np.arange(-6.0, 17.0)).astype(np.float32)


def prior_density(rows: int, columns: int) -> Float64[np.ndarray, "rows columns"]:
    """Return the prior's power spectrum at strength 1: its mean square difference of neighbours is 1."""
    y, x = np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(columns)
    power = (y**2 + x**2 + _FLAT_BELOW**2) ** (-_EXPONENT / 2)
    differences = 2 * (np.sin(np.pi * y) ** 2 + np.sin(np.pi * x) ** 2)
    return power / np.mean(power * differences)
