"""Read noise: the family of distributions that is fitted (Tukey's lambda), and the variance of any distribution."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.special import beta

from udccal.fitting.engine.orders import Quantity
from udccal.fitting.noise.moments import NoiseMoments

# The shape with the kurtosis of a normal distribution.
NORMAL_SHAPE: Final = 0.1349
Grid = Float[np.ndarray, " grid"]


def tukey_lambda_std(shape: float) -> float:
    """Standard deviation of the Tukey-lambda distribution with quantile (p^l - (1-p)^l) / l; l is not 0."""
    return float(np.sqrt(2.0 / shape**2 * (1.0 / (1 + 2 * shape) - beta(shape + 1, shape + 1))))


@functools.lru_cache(maxsize=64)
def standard_cdf(shape: float) -> tuple[Grid, Grid]:
    """Quantiles of the Tukey-lambda distribution of unit variance, and their probabilities."""
    p, tail = (1.0 / (1.0 + np.exp(sign * np.linspace(-24.0, 24.0, 6001))) for sign in (-1, 1))
    shape = shape if abs(shape) >= 1e-4 else 1e-4
    return (p**shape - tail**shape) / shape / tukey_lambda_std(shape), p


def excess_kurtosis(shape: float) -> float:
    """Excess kurtosis of the Tukey-lambda distribution: 1.2 for the logistic (0), 0 at 0.1349, negative above."""
    x, p = standard_cdf(shape)
    return float(0.5 * (x[1:] ** 4 + x[:-1] ** 4) @ np.diff(p)) - 3.0


def unexplained_variance(data: NoiseMoments, expected_DN2: Sequence[float], most_hits: float) -> Quantity:
    """Temporal variance of dark samples, without row noise, less that expected in each pair.

    It comes from the differences of the codes, and its sigma from their fourth moment. Differences taken for hits count
    where they are more than ``most_hits`` of all: radiation does not hit so often, so that they are tails of the noise,
    or pixels with random telegraph noise (EMVA 1288, clause 6.3, averages the variance over all pixels).
    """
    hits = sum(of.outliers for of in data.dark_moments)
    tails = hits > most_hits * sum(of.samples.sum() / of.frames for of in data.dark_moments)
    values, variances = [], []
    for pair, of, expected in zip(data.darks, data.dark_moments, expected_DN2, strict=True):
        pixels = float(of.samples.sum()) / of.frames
        second, fourth = of.outlier_powers if tails else (0.0, 0.0)
        value = float(np.average(of.variance_DN2, weights=of.dof)) + second / (2 * pixels)
        difference = pair.centres_DN[:, None] - pair.centres_DN
        fourth_moment = float(np.sum(pair.counts * difference**4) + fourth) / pixels
        values.append(value - expected)
        variances.append(max(fourth_moment / 4 - value**2, value**2) / pixels)
    weights = 1.0 / np.maximum(variances, 1e-30)
    return Quantity(float(np.average(values, weights=weights)), float(1.0 / weights.sum()))
