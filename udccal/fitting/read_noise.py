"""Dark noise by maximum likelihood of integer codes: black, dark current, sigma, Tukey-lambda shape and DSNU at once.

The likelihood is that of the pair of codes one pixel gave in two frames, with the rounding inside it. Rounding is
therefore exact where the noise is a fraction of a code, and not the usual 1/12.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt16
from scipy.special import gammaln

_MOST_CODES = 48
# Share of samples from anywhere in the window (hot and blinking pixels); keeps one outlier from deciding.
_BACKGROUND = 1e-5
_NODES, _NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(24)
_NODE_WEIGHTS = _NODE_WEIGHTS / _NODE_WEIGHTS.sum()
_LEAST_SHAPE, _MOST_SHAPE = -0.1, 0.45
PARAMETERS = ("black_DN", "dark_DN_per_s", "sigma_DN", "DSNU_DN", "lambda_read")


@dataclass(frozen=True)
class DarkPair:
    """A pair of dark frames reduced to the joint histogram of the two codes of each pixel."""

    exposure_s: float
    edges_DN: Float[np.ndarray, " codes_plus_1"]
    counts: Int[np.ndarray, "codes codes"]
    outside: int
    rows: int


@dataclass(frozen=True)
class DarkFit:
    """Values in the order of ``PARAMETERS``; ``edge_gain`` is d(mean code)/d(black), 1 when rounding is white."""

    values: Float[np.ndarray, "5"]
    cov: Float[np.ndarray, "5 5"]
    edge_gain: float
    converged: bool
    iterations: int


def dark_pair(
    first: UInt16[np.ndarray, "rows columns"],
    second: UInt16[np.ndarray, "rows columns"],
    exposure_s: float,
    q_DN: int = 1,
) -> DarkPair:
    """Joint histogram over a window of codes around the median; codes beyond it are counted as outside."""
    low, middle, high = np.percentile(first, [2.0, 50.0, 98.0])
    # 98th minus 2nd percentile is 4.1 sigma; 1.9 times that each side is about 7.8 sigma.
    half = int(np.ceil(1.9 * (high - low) / q_DN)) + 4
    group = max(1, int(np.ceil((2 * half + 1) / _MOST_CODES)))
    codes = (2 * half + 1 + group - 1) // group
    start = round(middle / q_DN) - half
    a = (first.astype(np.int64) // q_DN - start) // group
    b = (second.astype(np.int64) // q_DN - start) // group
    inside = (a >= 0) & (a < codes) & (b >= 0) & (b < codes)
    counts = np.bincount((a[inside] * codes + b[inside]).ravel(), minlength=codes * codes).reshape(codes, codes)
    edges = (start + group * np.arange(codes + 1) - 0.5) * q_DN
    return DarkPair(exposure_s, edges.astype(np.float64), counts, int(inside.size - inside.sum()), first.shape[0])


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


@functools.lru_cache(maxsize=1)
def _kurtosis_table() -> tuple[Float[np.ndarray, " shapes"], Float[np.ndarray, " shapes"]]:
    shapes = np.linspace(_LEAST_SHAPE, _MOST_SHAPE, 48)
    p = (np.arange(100_000) + 0.5) / 100_000
    excess = [float(np.mean(((p**s - (1 - p) ** s) / s / tukey_lambda_std(s)) ** 4)) - 3.0 for s in shapes]
    return shapes, np.array(excess)


def diluted_shape(shape: float, share: float) -> float:
    """Shape with the kurtosis that remains when only ``share`` of the variance is Tukey-lambda, the rest Gaussian."""
    shapes, excess = _kurtosis_table()
    kurtosis = float(np.interp(shape, shapes, excess)) * share**2
    return float(np.interp(-kurtosis, -excess, shapes))


@dataclass(frozen=True)
class Surroundings:
    """What is known apart from the histograms: conversion gain, and the row noise inside the dark noise."""

    K_DN_per_e: float
    sigma_row_DN: float


def _pair_probability(
    pair: DarkPair, values: Float[np.ndarray, "5"], known: Surroundings
) -> Float[np.ndarray, "codes codes"]:
    black, per_s, sigma, spread, shape = (float(v) for v in values)
    drift = per_s * pair.exposure_s
    # Shot noise of the dark current: K times its DN, added to the read noise's variance.
    width = np.sqrt(sigma**2 + known.K_DN_per_e * max(drift, 0.0))
    share = max(sigma**2 - known.sigma_row_DN**2, 0.25 * sigma**2) / width**2
    grid, cdf = _standard_cdf(diluted_shape(shape, share))
    centres = black + drift + spread * _NODES
    below = np.interp((pair.edges_DN[None, :] - centres[:, None]) / width, grid, cdf, left=0.0, right=1.0)
    single = np.diff(below, axis=1)
    joint = np.einsum("n,na,nb->ab", _NODE_WEIGHTS, single, single)
    return (1 - _BACKGROUND) * joint + _BACKGROUND / joint.size


def _log_likelihood(pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"], known: Surroundings) -> float:
    return float(sum(np.sum(pair.counts * np.log(_pair_probability(pair, values, known))) for pair in pairs))


def _bounded(values: Float[np.ndarray, "5"]) -> Float[np.ndarray, "5"]:
    low = np.array([-np.inf, -np.inf, 0.02, 1e-3, _LEAST_SHAPE])
    high = np.array([np.inf, np.inf, np.inf, np.inf, _MOST_SHAPE])
    return np.clip(values, low, high)


def _score_and_information(
    pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"], known: Surroundings
) -> tuple[Float[np.ndarray, "5"], Float[np.ndarray, "5 5"]]:
    step = np.array([1e-3, 1e-3, 1e-3, 1e-3, 2e-3]) * np.array([values[2], values[2], values[2], values[2], 1.0])
    step[1] /= max(max(pair.exposure_s for pair in pairs), 1e-9)
    score, information = np.zeros(5), np.zeros((5, 5))
    for pair in pairs:
        p = _pair_probability(pair, values, known).ravel()
        slopes = np.stack(
            [
                (_pair_probability(pair, values + d, known) - _pair_probability(pair, values - d, known)).ravel()
                for d in np.diag(step)
            ]
        ) / (2 * step[:, None])
        total = pair.counts.sum()
        score += slopes @ (pair.counts.ravel() / p)
        information += total * (slopes / p) @ slopes.T
    return score, information


def start_values(pairs: tuple[DarkPair, ...]) -> Float[np.ndarray, "5"]:
    """Moments of the histograms: the covariance of the two codes is the spread of the offsets."""
    times, means, variances, spreads = [], [], [], []
    for pair in pairs:
        centres = 0.5 * (pair.edges_DN[1:] + pair.edges_DN[:-1])
        share = pair.counts / max(pair.counts.sum(), 1)
        mean_a, mean_b = share.sum(axis=1) @ centres, share.sum(axis=0) @ centres
        spread = float((centres - mean_a) @ share @ (centres - mean_b))
        total = float(share.sum(axis=1) @ (centres - mean_a) ** 2)
        times.append(pair.exposure_s)
        means.append(0.5 * (mean_a + mean_b))
        spreads.append(spread)
        variances.append(total - spread)
    centred = np.array(times) - np.mean(times)
    norm = float(centred @ centred)
    slope = float(centred @ np.array(means)) / norm if norm > 0 else 0.0
    black = float(np.mean(means) - slope * np.mean(times))
    sigma = np.sqrt(max(min(variances) - 1.0 / 12.0, 0.05))
    return np.array([black, slope, sigma, np.sqrt(max(min(spreads), 0.003)), 0.12])


def fit_dark(pairs: tuple[DarkPair, ...], known: Surroundings, max_iterations: int = 40) -> DarkFit:
    """Fisher scoring with step halving on the likelihood of all pairs.

    The pairs share their pixels' offsets, so the information on black and DSNU does not add up over pairs: their
    sigmas are widened by the square root of the number of pairs. Row noise moves the mean of a whole frame; that is
    added to the sigmas of black and dark current.
    """
    values = _bounded(start_values(pairs))
    best = _log_likelihood(pairs, values, known)
    converged, iterations = False, 0
    while not converged and iterations < max_iterations:
        iterations += 1
        score, information = _score_and_information(pairs, values, known)
        step = _inverse(information) @ score
        for halving in range(12):
            trial = _bounded(values + step * 0.5**halving)
            value = _log_likelihood(pairs, trial, known)
            if value >= best:
                values, best = trial, value
                break
        # Half the squared step in units of sigma is what the likelihood can still gain.
        converged = bool(score @ step < 1e-3)
    _, information = _score_and_information(pairs, values, known)
    widen = np.sqrt(np.array([len(pairs), 1.0, 1.0, len(pairs), 1.0]))
    cov = _inverse(information) * np.outer(widen, widen)
    cov[:2, :2] += _frame_shift_cov(pairs, known.sigma_row_DN)
    return DarkFit(values, cov, _edge_gain(pairs, values, known), converged, iterations)


def _frame_shift_cov(pairs: tuple[DarkPair, ...], sigma_row: float) -> Float[np.ndarray, "2 2"]:
    design = np.array([[1.0, pair.exposure_s] for pair in pairs])
    weight = np.array([2.0 * pair.rows for pair in pairs]) / max(sigma_row, 1e-6) ** 2
    return np.linalg.pinv(design.T @ (design * weight[:, None]), hermitian=True)


def _inverse(information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    root = np.sqrt(np.maximum(np.diag(information), 1e-300))
    outer = np.outer(root, root)
    return np.linalg.pinv(information / outer, rcond=1e-10) / outer


def _edge_gain(pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"], known: Surroundings) -> float:
    """Root mean square over the pairs, as row noise is measured over all of them."""
    step = np.array([0.01 * values[2], 0.0, 0.0, 0.0, 0.0])
    gains = []
    for pair in pairs:
        centres = 0.5 * (pair.edges_DN[1:] + pair.edges_DN[:-1])
        rise = _pair_probability(pair, values + step, known) - _pair_probability(pair, values - step, known)
        gains.append(float(rise.sum(axis=1) @ centres / (2 * step[0])))
    return float(np.sqrt(np.mean(np.square(gains))))
