"""A pair of dark frames as the joint histogram of the two codes of each pixel, and how probable each pair of codes is.

The rounding is inside the probability. It is therefore exact where the noise is a fraction of a code, and not the usual
1/12; and codes that stop at 0 or at the converter's end are censored: they tell that the signal lies beyond, and no
more. Nothing is taken for normal that is not: few electrons of dark current are as skewed as Poisson says.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.special import gammaln

from udccal.fitting.noise.moments import Codes

_MOST_CODES = 160
# Samples of a strip, which stays in the processor's cache.
_STRIP = 1 << 18
# The shape with the kurtosis of a normal distribution.
NORMAL_SHAPE = 0.1349
# Where a Tukey-lambda shape is 0 its formulas have no value.
_LOGISTIC = 1e-4
# Points of the distribution's grid. Peaks of single counts are as narrow as the read noise: so many points to its
# standard deviation, down to this in DN.
_FEWEST_POINTS, _MOST_POINTS = 4096, 65536
_PER_SIGMA, _FINEST_DN, _HALF_WIDTHS = 3.0, 0.02, 14.0
# Nodes of the offset's normal distribution: this far out, this many per width of the temporal noise.
_REACH, _NODES_PER_WIDTH, _FEWEST_NODES, _MOST_NODES = 5.5, 1.6, 13, 1201


@final
@dataclass(frozen=True)
class DarkPair:
    """A pair of dark frames reduced to the joint histogram of the two codes of each pixel.

    The outermost edges are infinite where the codes stop there (at 0, or at the converter's end).
    """

    exposure_s: float
    edges_DN: Float[np.ndarray, " codes_plus_1"]
    counts: Int[np.ndarray, "codes codes"]
    outside: int
    rows: int

    @property
    def step_DN(self) -> float:
        """The smallest width of a group of codes."""
        return float(np.min(np.diff(self.edges_DN)))

    @property
    def centres_DN(self) -> Float[np.ndarray, " codes"]:
        """Middle of each group of codes; of a cut-off end, where its neighbours would put it."""
        edges = self.edges_DN.copy()
        step = self.step_DN if np.isfinite(self.step_DN) else 1.0
        edges[0] = edges[0] if np.isfinite(edges[0]) else edges[1] - step
        edges[-1] = edges[-1] if np.isfinite(edges[-1]) else edges[-2] + step
        return np.asarray(0.5 * (edges[1:] + edges[:-1]))


def dark_pair(first: Codes, second: Codes, exposure_s: float, q_DN: int = 1, top_code: int = 65535) -> DarkPair:
    """Joint histogram over a window of codes around the median; codes beyond it are counted as outside."""
    low, middle, high = np.percentile(first[:: max(1, first.size // 65536)], [2.0, 50.0, 98.0])
    # 98th minus 2nd percentile is 4.1 sigma; 1.9 times that each side is about 7.8 sigma.
    half = int(np.ceil(1.9 * (high - low) / q_DN)) + 4
    group = max(1, int(np.ceil((2 * half + 1) / _MOST_CODES)))
    start = max(round(middle / q_DN) - half, 0)
    codes = min((round(middle / q_DN) + half - start) // group, (top_code // q_DN - start) // group) + 1
    # One more group takes all that lies outside the window, codes below it included: they wrap around.
    side = codes + 1
    joint = np.zeros(side * side, np.int64)

    def groups(frame: Codes) -> Codes:
        shifted = (frame // np.uint16(q_DN) if q_DN > 1 else frame) - np.uint16(start)
        if group > 1:
            shifted = np.where(shifted < group * codes, shifted // np.uint16(group), np.uint16(codes))
        return np.minimum(shifted, np.uint16(codes))

    height = max(_STRIP // first.shape[1], 1)
    for top in range(0, first.shape[0], height):
        index = groups(first[top : top + height]) * np.uint16(side) + groups(second[top : top + height])
        joint += cv2.calcHist([index], [0], None, [joint.size], [0, joint.size]).ravel().astype(np.int64)
    counts = joint.reshape(side, side)[:codes, :codes]
    edges = (start + group * np.arange(codes + 1) - 0.5) * q_DN
    edges[0] = -np.inf if start == 0 else edges[0]
    edges[-1] = np.inf if edges[-1] >= top_code else edges[-1]
    return DarkPair(exposure_s, edges.astype(np.float64), counts, int(first.size - counts.sum()), first.shape[0])


def _tukey_lambda(p: Float[np.ndarray, " n"], tail: Float[np.ndarray, " n"], shape: float) -> Float[np.ndarray, " n"]:
    """Quantiles of the Tukey-lambda distribution of unit variance; ``tail`` is 1 - p."""
    safe = shape if abs(shape) >= _LOGISTIC else _LOGISTIC
    return np.asarray((p**safe - tail**safe) / safe / tukey_lambda_std(safe))


def tukey_lambda_std(shape: float) -> float:
    """Standard deviation of the Tukey-lambda distribution with quantile (p^l - (1-p)^l) / l."""
    if abs(shape) < _LOGISTIC:
        return float(np.pi / np.sqrt(3.0))
    ratio = np.exp(2 * gammaln(shape + 1) - gammaln(2 * shape + 2))
    return float(np.sqrt(2.0 / shape**2 * (1.0 / (1 + 2 * shape) - ratio)))


def excess_kurtosis(shape: float) -> float:
    """Of the Tukey-lambda distribution: 1.2 for the logistic (0), 0 at 0.1349, negative above."""
    p = (np.arange(100_000) + 0.5) / 100_000
    return float(np.mean(_tukey_lambda(p, 1 - p, shape) ** 4)) - 3.0


@functools.lru_cache(maxsize=64)
def _standard_cdf(shape: float) -> tuple[Float[np.ndarray, " grid"], Float[np.ndarray, " grid"]]:
    p, tail = (1.0 / (1.0 + np.exp(sign * np.linspace(-24.0, 24.0, 6001))) for sign in (-1, 1))
    return _tukey_lambda(p, tail, shape), p


@functools.lru_cache(maxsize=128)
def _dark_cdf(
    sigma_DN: float, shape: float, row_DN: float, dark_DN: float, K_DN_per_e: float
) -> tuple[Float[np.ndarray, " grid"], Float[np.ndarray, " grid"]]:
    """Places (DN from the mean) and the probability that a dark sample lies below them before rounding.

    Tukey-lambda read noise, normal row noise and Poisson counts of ``dark_DN`` in all are independent: their
    distribution is a convolution, made as a product of spectra.
    """
    variance = sigma_DN**2 + row_DN**2 + K_DN_per_e * max(dark_DN, 0.0)
    reach = _HALF_WIDTHS * np.sqrt(variance) + 2 * K_DN_per_e * (dark_DN > 0)
    wanted = 2 * reach * _PER_SIGMA / max(sigma_DN, _PER_SIGMA * _FINEST_DN)
    points = int(np.clip(2 ** np.ceil(np.log2(wanted)), _FEWEST_POINTS, _MOST_POINTS))
    step = 2 * reach / points
    edges = step * (np.arange(points + 1) - points // 2 - 0.5)
    grid, cdf = _standard_cdf(shape)
    mass = np.diff(np.interp(edges / max(sigma_DN, 1e-12), grid, cdf, left=0.0, right=1.0))
    u = 2 * np.pi * np.fft.rfftfreq(points, step)
    # Narrower than the grid it would ring: then it is widened to one step.
    smear = step if sigma_DN < 2 * step else 0.0
    log_phase = -0.5 * (row_DN**2 + smear**2) * u**2 + 0j
    if dark_DN > 0 and K_DN_per_e > 0:
        log_phase = log_phase + dark_DN / K_DN_per_e * (np.exp(-1j * u * K_DN_per_e) - 1 + 1j * u * K_DN_per_e)
    mass = np.fft.irfft(np.fft.rfft(mass) * np.exp(log_phase), points)
    return edges[1:], np.clip(np.maximum.accumulate(np.cumsum(mass)), 0.0, 1.0)


@final
@dataclass(frozen=True)
class Surroundings:
    """What is known apart from the histograms: gain, row noise, and the share of samples from anywhere."""

    K_DN_per_e: float
    sigma_row_DN: float
    background: float


def pair_probability(
    pair: DarkPair, values: Float[np.ndarray, "5"], known: Surroundings
) -> Float[np.ndarray, "codes codes"]:
    """Of the two codes of a pixel in a pair of dark frames.

    Args:
        pair: for its exposure and its groups of codes.
        values: black [DN], dark current [DN/s], variance of single samples without row noise and of the pixels'
            offsets [DN^2], Tukey-lambda shape.
        known: what is known besides.
    """
    black, per_s, variance, spread2, shape = (float(v) for v in values)
    drift = per_s * pair.exposure_s
    grid, cdf = _dark_cdf(np.sqrt(variance), shape, known.sigma_row_DN, drift, known.K_DN_per_e)
    # Counts of dark current widen the distribution but leave its peaks as narrow as the read noise. Evenly spaced
    # nodes are for a smooth integrand as good as any quadrature.
    width, spread = max(np.sqrt(variance + known.sigma_row_DN**2), 1e-9), np.sqrt(spread2)
    number = int(np.clip(np.ceil(2 * _REACH * spread * _NODES_PER_WIDTH / width), _FEWEST_NODES, _MOST_NODES)) | 1
    z = np.linspace(-_REACH, _REACH, number)
    weights = np.exp(-0.5 * z**2)
    centres = black + drift + spread * z
    below = np.interp(pair.edges_DN[None, :] - centres[:, None], grid, cdf, left=0.0, right=1.0)
    single = np.diff(below, axis=1)
    joint = (single * (weights / weights.sum())[:, None]).T @ single
    return np.asarray((1 - known.background) * joint + known.background / joint.size)
