"""The sensor's gain by the variance of flats from frame to frame, over the profile's (EMVA 1288's photon transfer)."""

from __future__ import annotations

import numpy as np

from udccal.cfa import cfa_named
from udccal.fitting.noise.transfer import linear_signal, temporal_variance
from udccal.models.noise import Noise
from udccal.result import FitResult
from udccal.sessions.store import Average
from udccal.validation.noise import transfer_numbers

# A sample variance beyond this many medians is a pixel that blinks, not noise.
_BLINKS = 30.0


def gain_ratio(flat: Average, dark: Average, result: FitResult[Noise], cfa: str) -> tuple[float, float]:
    """Return the gain over the profile's, and its sigma, from averages of flats and of darks at one exposure."""
    (K, _, _, _, curvature), cov = transfer_numbers(result)
    seen = expected = noise = 0.0
    for site in cfa_named(cfa).sites:
        lit, unlit = flat.variance[site.samples].astype(np.float64), dark.variance[site.samples].astype(np.float64)
        steady = (lit < _BLINKS * np.median(lit)) & (unlit < _BLINKS * max(float(np.median(unlit)), 1e-9))
        light = (flat.mean[site.samples] - dark.mean[site.samples]).astype(np.float64)[steady]
        signal = linear_signal(light, curvature, K)
        seen += float(np.sum(lit[steady] - unlit[steady]))
        expected += float(np.sum(temporal_variance(signal, K, 0.0, curvature, 0.0)))
        noise += 2 * float(np.sum(lit[steady] ** 2 / (flat.frames - 1) + unlit[steady] ** 2 / (dark.frames - 1)))
    own = float(np.sqrt(cov[0, 0])) / K
    return seen / expected, float(np.hypot(np.sqrt(noise) / expected, own))
