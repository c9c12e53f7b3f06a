"""The sensor's gain by the variance of flats from frame to frame, over the profile's (EMVA 1288's photon transfer)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from udccal.cfa import cfa_named
from udccal.fitting.noise.response import linear_mean, temporal_variance
from udccal.models.noise import Noise
from udccal.result import FitResult
from udccal.sessions.store import Average
from udccal.validation.noise import transfer_numbers

# A sample variance beyond this many medians is a pixel that blinks, not noise.
_BLINKS = 30.0
# Darker pixels, as a part of their site's median, tell nothing of the gain by themselves.
_LIT = 0.05
# Flicker is shown by the data from this many of its sigmas on.
_SHOWN = 4.0


@final
@dataclass(frozen=True)
class GainRatio:
    """The gain over the profile's.

    Attributes:
        value, sigma: the ratio.
        flicker: standard deviation of the light from frame to frame, relative; 0 where the data show none.
        raised: how much of ``value`` that flicker is.
    """

    value: float
    sigma: float
    flicker: float = 0.0
    raised: float = 0.0


def gain_ratio(flat: Average, dark: Average, result: FitResult[Noise], cfa: str) -> GainRatio:
    """Return the gain over the profile's from averages of flats and of darks at one exposure.

    A lamp that flickers adds variance as the square of the light, the gain's grows as the light: pixels of different
    light tell the two apart. The ratio is that of all variance; flicker is only told.
    """
    (K, _, _, _, curvature), cov, cubic = transfer_numbers(result)
    seen = expected = noise = square = 0.0
    equations, right = np.zeros((2, 2)), np.zeros(2)
    for site in cfa_named(cfa).sites:
        lit, unlit = flat.variance[site.samples].astype(np.float64), dark.variance[site.samples].astype(np.float64)
        light = (flat.mean[site.samples] - dark.mean[site.samples]).astype(np.float64)
        steady = (lit < _BLINKS * np.median(lit)) & (unlit < _BLINKS * max(float(np.median(unlit)), 1e-9))
        steady &= light > max(_LIT * float(np.median(light)), 0.0)
        signal = linear_mean(light[steady], curvature, cubic, K)
        own, more = temporal_variance(signal, K, 0.0, curvature, 0.0, cubic=cubic), lit[steady] - unlit[steady]
        seen += float(np.sum(more))
        expected += float(np.sum(own))
        square += float(np.sum(light[steady] ** 2))
        noise += 2 * float(np.sum(lit[steady] ** 2 / (flat.frames - 1) + unlit[steady] ** 2 / (dark.frames - 1)))
        slopes = np.stack([np.ones_like(own), light[steady] ** 2 / own])
        equations += slopes @ slopes.T
        right += slopes @ (more / own)
    sigma = float(np.hypot(np.sqrt(noise) / expected, np.sqrt(cov[0, 0]) / K))
    flicker = _flicker(equations, right, flat.frames)
    return GainRatio(seen / expected, sigma, flicker, flicker**2 * square / expected)


def _flicker(equations: np.ndarray, right: np.ndarray, frames: int) -> float:
    """Solve for gain and flicker together; each variance over the expected one has the variance 2 / (frames - 1)."""
    unit = np.sqrt(np.diag(equations))
    scaled = equations / np.outer(unit, unit)
    # Light alike in all pixels cannot tell the two apart.
    if scaled[0, 1] > 1 - 1e-6:
        return 0.0
    gain, flicker = np.linalg.solve(scaled, right / unit)
    sigma = gain / unit[0] * np.sqrt(2 / (frames - 1) * np.linalg.inv(scaled)[1, 1])
    return float(np.sqrt(flicker / unit[1])) if flicker > _SHOWN * sigma else 0.0
