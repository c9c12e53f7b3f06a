"""Fisher information of Gaussian, possibly clipped samples.

The model is given as one pure JAX function from parameters to the mean and variance of every sample. Its derivatives
come from automatic differentiation, so that a bound and a fit share one likelihood. With mean m, variance v and samples
clipped at c, the information of one sample is

    I = m' m'^T / v  w_m(z) + v' v'^T / (2 v^2) w_v(z) + cross terms,   z = (c - m) / sqrt(v),

where the weights are 1 far below the clipping (Kay, Fundamentals of Statistical Signal Processing I, eq. 3.31; for
the clipped normal: Amemiya, Econometrica 41, 1973).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float
from scipy.special import log_ndtr, ndtr

from udccal.numerics import in_float64

# Parameters to (mean, variance) of every sample.
Predict = Callable[..., tuple[Float[Array, " samples"], Float[Array, " samples"]]]


@in_float64
def fisher_information(
    predict: Predict, x: Float[np.ndarray, " n"], *args: Any, clip: float = np.inf
) -> Float[np.ndarray, "n n"]:
    """Fisher information on ``x`` in independent samples, expected over the noise; the module has the formula.

    Args:
        predict: pure JAX function at module scope; ``predict(x, *args)`` gives mean and variance of each sample.
        x: the n parameters.
        args: further arguments of ``predict``.
        clip: samples at or above this value are known only to lie there; in the unit of the means.
    """
    (mean, variance), (mean_slope, variance_slope) = (
        tuple(np.asarray(part, dtype=np.float64) for part in pair) for pair in _linearised(predict, x, args)
    )
    sigma = np.sqrt(variance)
    # Scores are linear in (u, u^2) below the clipping, u = (y - mean) / sigma.
    by_mean, by_sigma = mean_slope / sigma[:, None], 0.5 * variance_slope / variance[:, None]
    own, cross, square = _clipped_moments((clip - mean) / sigma)
    mixed = by_mean.T @ (by_sigma * cross[:, None])
    return by_mean.T @ (by_mean * own[:, None]) + mixed + mixed.T + by_sigma.T @ (by_sigma * square[:, None])


@functools.partial(jax.jit, static_argnums=0)
def _linearised(
    predict: Predict, x: Float[Array, " n"], args: tuple[Any, ...]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    def at(values: Array) -> tuple[Array, Array]:
        return predict(values, *args)

    return at(x), jax.jacfwd(at)(x)


def _clipped_moments(
    z: Float[np.ndarray, " samples"],
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]:
    """Information (mean, mean), (mean, sigma) and (sigma, sigma) of a unit normal clipped at ``z``."""
    z = np.clip(z, -30.0, 40.0)
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    below = ndtr(z)
    # density / (1 - below), without 0 / 0 far above.
    hazard = np.exp(-0.5 * z**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(-z))
    first = below - z * density + density * hazard
    # Below: E[u (u^2 - 1)] = -density (z^2 + 1) over u < z; clipped: (z h) h (1 - below) = z density hazard.
    cross = -density * (z**2 + 1) + z * density * hazard
    square = 2 * below - density * (z**3 + z) + z**2 * density * hazard
    return np.maximum(first, 0.0), cross, np.maximum(square, 0.0)
