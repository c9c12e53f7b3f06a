"""A sensor's response z - c z^2 - d z^3 to a linear signal z: its temporal variance, and its inverse for means."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.models.noise import linear_signal

Means = Float[np.ndarray, "*means"]

# Newton's rounds, and the least slope in them: a response that falls is none.
_ROUNDS, _LEAST_SLOPE = 4, 0.1


def steepness(signal_DN, curvature_per_DN, cubic=0.0):  # type: ignore[no-untyped-def]
    """The response's derivative at a linear signal; arguments and result are numpy or JAX arrays."""
    return 1 - (2 * curvature_per_DN + 3 * cubic * signal_DN) * signal_DN


def temporal_variance(signal_DN, K_DN_per_e, V0_DN2, curvature_per_DN, rounding_DN2, gain_noise2=0.0, cubic=0.0):  # type: ignore[no-untyped-def]
    """Temporal variance in DN^2 (EMVA 1288, clause 6) of a linear signal z above black, as in ``transfer``.

    Arguments and result are numpy or JAX arrays; the curvature c is 0 for a linear response, the rounding q^2 / 12.
    """
    light = (K_DN_per_e + gain_noise2 * signal_DN) * signal_DN
    return light * steepness(signal_DN, curvature_per_DN, cubic) ** 2 + V0_DN2 + rounding_DN2


def linear_mean(mean_DN: Means, curvature: Means | float, cubic: Means | float, K_DN_per_e: Means | float) -> Means:
    """The linear signal of means of many frames: the inverse of z - c (z^2 + K z) - d (z^3 + 3 K z^2 + K^2 z).

    K z is the variance of shot noise, and K^2 z its third moment.
    """
    K, z = K_DN_per_e, linear_signal(mean_DN, curvature, K_DN_per_e)
    for _ in range(_ROUNDS if np.any(cubic) else 0):
        missing = curvature * (z + K) + cubic * (z**2 + 3 * K * z + K**2)
        slope = 1 - curvature * (2 * z + K) - cubic * (3 * z**2 + 6 * K * z + K**2)
        z = z + (mean_DN - z * (1 - missing)) / np.maximum(slope, _LEAST_SLOPE)
    return z
