"""Distribution of one dark sample before rounding: Tukey-lambda read noise, normal row noise, Poisson dark current.

The three are independent, so their distribution is a convolution, made as a product of spectra. Nothing is taken for
normal that is not: few electrons of dark current are as skewed as Poisson says.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

_FEWEST_POINTS, _MOST_POINTS = 4096, 65536
# Peaks of single counts are as narrow as the read noise: so many points to its standard deviation, down to this in DN.
_PER_SIGMA, _FINEST_DN = 3.0, 0.02
_HALF_WIDTHS = 14.0
LEAST_SHAPE, MOST_SHAPE = -0.1, 0.45
# The shape with the kurtosis of a normal distribution.
NORMAL_SHAPE = 0.1349


def tukey_lambda_std(shape: float) -> float:
    """Standard deviation of the Tukey-lambda distribution with quantile (p^l - (1-p)^l) / l."""
    if abs(shape) < 1e-4:
        return float(np.pi / np.sqrt(3.0))
    ratio = np.exp(2 * gammaln(shape + 1) - gammaln(2 * shape + 2))
    return float(np.sqrt(2.0 / shape**2 * (1.0 / (1 + 2 * shape) - ratio)))


@functools.lru_cache(maxsize=64)
def _standard_cdf(shape: float) -> tuple[Float[np.ndarray, " grid"], Float[np.ndarray, " grid"]]:
    p = 1.0 / (1.0 + np.exp(-np.linspace(-24.0, 24.0, 6001)))
    tail = 1.0 / (1.0 + np.exp(np.linspace(-24.0, 24.0, 6001)))
    safe = shape if abs(shape) >= 1e-4 else 1e-4
    return (p**safe - tail**safe) / safe / tukey_lambda_std(safe), p


def excess_kurtosis(shape: float) -> float:
    """Of the Tukey-lambda distribution: 1.2 for the logistic (0), 0 at 0.1349, negative above."""
    p = (np.arange(100_000) + 0.5) / 100_000
    safe = shape if abs(shape) >= 1e-4 else 1e-4
    return float(np.mean(((p**safe - (1 - p) ** safe) / safe / tukey_lambda_std(safe)) ** 4)) - 3.0


@functools.lru_cache(maxsize=128)
def dark_cdf(
    sigma_DN: float, shape: float, row_DN: float, dark_DN: float, K_DN_per_e: float
) -> tuple[Float[np.ndarray, " grid"], Float[np.ndarray, " grid"]]:
    """Places (DN from the mean) and the probability of lying below them.

    Args:
        sigma_DN: standard deviation of the read noise of single samples.
        shape: its Tukey-lambda shape.
        row_DN: standard deviation of the row noise.
        dark_DN: mean dark signal, that is K times the mean count.
        K_DN_per_e: size of one count.
    """
    variance = sigma_DN**2 + row_DN**2 + K_DN_per_e * max(dark_DN, 0.0)
    reach = _HALF_WIDTHS * np.sqrt(variance) + 2 * K_DN_per_e * (dark_DN > 0)
    wanted = 2 * reach * _PER_SIGMA / max(sigma_DN, _PER_SIGMA * _FINEST_DN)
    points = int(np.clip(2 ** np.ceil(np.log2(wanted)), _FEWEST_POINTS, _MOST_POINTS))
    step = 2 * reach / points
    places = step * (np.arange(points) - points // 2)
    grid, cdf = _standard_cdf(shape)
    edges = np.append(places, places[-1] + step) - 0.5 * step
    mass = np.diff(np.interp(edges / max(sigma_DN, 1e-12), grid, cdf, left=0.0, right=1.0))
    u = 2 * np.pi * np.fft.rfftfreq(points, step)
    # Narrower than the grid it would ring: then it is widened to one step.
    smear = step if sigma_DN < 2 * step else 0.0
    log_phase = -0.5 * (row_DN**2 + smear**2) * u**2 + 0j
    if dark_DN > 0 and K_DN_per_e > 0:
        log_phase = log_phase + dark_DN / K_DN_per_e * (np.exp(-1j * u * K_DN_per_e) - 1 + 1j * u * K_DN_per_e)
    mass = np.fft.irfft(np.fft.rfft(mass) * np.exp(log_phase), points)
    return places + 0.5 * step, np.clip(np.maximum.accumulate(np.cumsum(mass)), 0.0, 1.0)
