"""Dark noise by maximum likelihood of integer codes: black, dark current, sigma, Tukey-lambda shape and DSNU at once.

The likelihood is that of the pair of codes one pixel gave in two frames, with the rounding inside it. Rounding is
therefore exact where the noise is a fraction of a code, and not the usual 1/12; and codes that stop at 0 or at the
converter's end are censored samples: they tell that the signal lies beyond, and no more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt16

from udccal.fitting.iteration_log import LOG
from udccal.fitting.noise_density import LEAST_SHAPE, MOST_SHAPE, NORMAL_SHAPE, dark_cdf

_MOST_CODES = 160
# Share of samples from anywhere in the window (hot and blinking pixels); keeps one outlier from deciding.
_BACKGROUND = 1e-5
# Prior on the shape, wide beside any real sensor's; it decides only where rounding hides the shape.
_SHAPE_SIGMA = 0.3
# Nodes of the offset's normal distribution: this far out, this many per width of the temporal noise.
_REACH, _NODES_PER_WIDTH, _FEWEST_NODES, _MOST_NODES = 5.5, 1.6, 13, 1201
PARAMETERS = ("black_DN", "dark_DN_per_s", "variance_DN2", "DSNU_DN2", "lambda_read")


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


@dataclass(frozen=True)
class DarkFit:
    """Values in the order of ``PARAMETERS``: variances of single samples without row noise.

    ``edge_gains`` is d(mean code)/d(black) per pair: 1 when rounding is white and no code is cut off. ``deviance`` is
    minus twice the log-likelihood of the histograms.
    """

    values: Float[np.ndarray, "5"]
    cov: Float[np.ndarray, "5 5"]
    edge_gains: Float[np.ndarray, " pairs"]
    deviance: float
    converged: bool
    iterations: int


@dataclass(frozen=True)
class Surroundings:
    """What is known apart from the histograms: conversion gain, and the row noise beside the read noise."""

    K_DN_per_e: float
    sigma_row_DN: float


def dark_pair(
    first: UInt16[np.ndarray, "rows columns"],
    second: UInt16[np.ndarray, "rows columns"],
    exposure_s: float,
    q_DN: int = 1,
    top_code: int = 65535,
) -> DarkPair:
    """Joint histogram over a window of codes around the median; codes beyond it are counted as outside."""
    sample = first[:: max(1, first.size // 65536)]
    low, middle, high = np.percentile(sample, [2.0, 50.0, 98.0])
    # 98th minus 2nd percentile is 4.1 sigma; 1.9 times that each side is about 7.8 sigma.
    half = int(np.ceil(1.9 * (high - low) / q_DN)) + 4
    group = max(1, int(np.ceil((2 * half + 1) / _MOST_CODES)))
    start = max(round(middle / q_DN) - half, 0)
    codes = min((round(middle / q_DN) + half - start) // group, (top_code // q_DN - start) // group) + 1
    # One more group takes all that lies outside the window, codes below it included: they wrap around.
    side = codes + 1
    index = _code_groups(first, start, group, q_DN, codes) * np.uint16(side)
    index += _code_groups(second, start, group, q_DN, codes)
    counts = np.bincount(index.ravel(), minlength=side * side).reshape(side, side)[:codes, :codes]
    edges = (start + group * np.arange(codes + 1) - 0.5) * q_DN
    edges[0] = -np.inf if start == 0 else edges[0]
    edges[-1] = np.inf if edges[-1] >= top_code else edges[-1]
    return DarkPair(exposure_s, edges.astype(np.float64), counts, int(first.size - counts.sum()), first.shape[0])


def _code_groups(
    frame: UInt16[np.ndarray, "rows columns"], start: int, group: int, q_DN: int, codes: int
) -> UInt16[np.ndarray, "rows columns"]:
    shifted = frame // np.uint16(q_DN) if q_DN > 1 else frame
    below = shifted < np.uint16(start) if group > 1 else None
    shifted = shifted - np.uint16(start)
    if group > 1:
        shifted //= np.uint16(group)
        # A wrapped code may come to lie inside once it is divided.
        shifted[below] = codes
    return np.minimum(shifted, np.uint16(codes), out=shifted)


def centres_DN(pair: DarkPair) -> Float[np.ndarray, " codes"]:
    """Middle of each group of codes; of a cut-off end, where its neighbours would put it."""
    edges = pair.edges_DN
    step = float(np.median(np.diff(edges[np.isfinite(edges)]))) if np.isfinite(edges).sum() > 1 else 1.0
    middle = 0.5 * (edges[1:] + edges[:-1])
    if np.isinf(edges[0]):
        middle[0] = edges[1] - 0.5 * step
    if np.isinf(edges[-1]):
        middle[-1] = edges[-2] + 0.5 * step
    return middle


def _nodes(spread: float, width: float) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
    """Offsets in DN and their weights: evenly spaced, which for a smooth integrand is as good as any quadrature."""
    wanted = 2 * _REACH * spread * _NODES_PER_WIDTH / max(width, 1e-9)
    number = int(np.clip(np.ceil(wanted), _FEWEST_NODES, _MOST_NODES)) | 1
    z = np.linspace(-_REACH, _REACH, number)
    weights = np.exp(-0.5 * z**2)
    return spread * z, weights / weights.sum()


def _pair_probability(
    pair: DarkPair, values: Float[np.ndarray, "5"], known: Surroundings
) -> Float[np.ndarray, "codes codes"]:
    black, per_s, variance, spread2, shape = (float(v) for v in values)
    drift = per_s * pair.exposure_s
    grid, cdf = dark_cdf(np.sqrt(variance), shape, known.sigma_row_DN, drift, known.K_DN_per_e)
    # Counts of dark current widen the distribution but leave its peaks as narrow as the read noise.
    offsets, weights = _nodes(np.sqrt(spread2), np.sqrt(variance + known.sigma_row_DN**2))
    centres = black + drift + offsets
    below = np.interp(pair.edges_DN[None, :] - centres[:, None], grid, cdf, left=0.0, right=1.0)
    single = np.diff(below, axis=1)
    joint = (single * weights[:, None]).T @ single
    return (1 - _BACKGROUND) * joint + _BACKGROUND / joint.size


def _deviance(pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"], known: Surroundings) -> float:
    likelihood = sum(float(np.sum(pair.counts * np.log(_pair_probability(pair, values, known)))) for pair in pairs)
    return -2.0 * likelihood - 2.0 * _log_prior(values)


def _log_prior(values: Float[np.ndarray, "5"]) -> float:
    return -0.5 * ((float(values[4]) - NORMAL_SHAPE) / _SHAPE_SIGMA) ** 2


# Variances at these are those of none: three hundredths of a code, a thousandth for the offsets.
LEAST_VARIANCE = 1e-3
_LOW = np.array([-np.inf, -np.inf, LEAST_VARIANCE, 1e-6, LEAST_SHAPE])
_HIGH = np.array([np.inf, np.inf, np.inf, np.inf, MOST_SHAPE])


def _steps(pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"]) -> Float[np.ndarray, "5"]:
    """For slopes by differences: small beside the noise, large beside the arithmetic."""
    width = float(np.sqrt(values[2] + 0.01))
    longest = max(max(pair.exposure_s for pair in pairs), 1e-9)
    variance = 2e-3 * width**2
    return np.array([2e-3 * width, 2e-3 * width / longest, variance, max(1e-3 * values[3], 1e-4 * variance), 2e-3])


def _slopes(
    pair: DarkPair,
    at: Float[np.ndarray, "codes codes"],
    values: Float[np.ndarray, "5"],
    steps: Float[np.ndarray, "5"],
    known: Surroundings,
) -> Float[np.ndarray, "5 cells"]:
    """One-sided: the second order, which that leaves, sums to nothing in the score at the truth."""
    slopes = []
    for index, step in enumerate(np.diag(steps)):
        moved = values + step if values[index] + steps[index] <= _HIGH[index] else values - step
        rise = _pair_probability(pair, moved, known) - at
        slopes.append(rise.ravel() / (moved[index] - values[index]))
    return np.stack(slopes)


def _score_and_information(
    pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"], known: Surroundings, free: np.ndarray
) -> tuple[Float[np.ndarray, "5"], Float[np.ndarray, "5 5"]]:
    steps = _steps(pairs, values)
    score, information = np.zeros(5), np.zeros((5, 5))
    for pair in pairs:
        joint = _pair_probability(pair, values, known)
        slopes, p = _slopes(pair, joint, values, steps, known), joint.ravel()
        score += slopes @ (pair.counts.ravel() / p)
        information += float(pair.counts.sum()) * (slopes / p) @ slopes.T
    score[4] -= (values[4] - NORMAL_SHAPE) / _SHAPE_SIGMA**2
    information[4, 4] += 1 / _SHAPE_SIGMA**2
    return np.where(free, score, 0.0), np.where(np.outer(free, free), information, 0.0)


def information(
    pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"], known: Surroundings
) -> Float[np.ndarray, "5 5"]:
    """Expected information on ``values`` in histograms of that many samples, for bounds; the prior's is in it."""
    return _score_and_information(pairs, values, known, np.ones(5, bool))[1]


def start_values(pairs: tuple[DarkPair, ...]) -> Float[np.ndarray, "5"]:
    """Moments of the histograms: the covariance of the two codes is the variance of the offsets."""
    times, means, variances, spreads = [], [], [], []
    for pair in pairs:
        centres = centres_DN(pair)
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
    variance = max(min(variances) - 1.0 / 12.0, 0.05)
    return np.array([black, slope, variance, max(min(spreads), 0.003), NORMAL_SHAPE])


def fit_dark(
    pairs: tuple[DarkPair, ...],
    known: Surroundings,
    start: Float[np.ndarray, "5"] | None = None,
    normal: bool = False,
    max_iterations: int = 40,
) -> DarkFit:
    """Fisher scoring with step halving on the likelihood of all pairs.

    The pairs share their pixels' offsets, so the information on DSNU does not add up over pairs: its sigma is widened
    by the square root of their number. Row noise in ``known`` is that of the population; the mean levels that decide
    black and dark current carry their own weights (see ``dark_levels``).

    Args:
        pairs: the histograms.
        known: what is known besides.
        start: values to begin with; moments otherwise.
        normal: hold the shape at that of normal noise.
        max_iterations: upper bound.
    """
    values = np.clip(start_values(pairs) if start is None else start, _LOW, _HIGH)
    one_exposure = len({pair.exposure_s for pair in pairs}) < 2
    free = np.array([True, not one_exposure, True, True, not normal])
    values[1] = 0.0 if one_exposure else values[1]
    values[4] = NORMAL_SHAPE if normal else values[4]
    best = _deviance(pairs, values, known)
    converged, iterations = False, 0
    while not converged and iterations < max_iterations:
        iterations += 1
        score, information = _score_and_information(pairs, values, known, free)
        # At a bound with the score pointing outwards the bound is the answer.
        inside = free & ~((values <= _LOW) & (score < 0)) & ~((values >= _HIGH) & (score > 0))
        step = inverse(np.where(np.outer(inside, inside), information, 0.0)) @ np.where(inside, score, 0.0)
        gained = 0.0
        for halving in range(12):
            trial = np.clip(values + step * 0.5**halving, _LOW, _HIGH)
            deviance = _deviance(pairs, trial, known)
            if deviance <= best:
                gained, values, best = best - deviance, trial, deviance
                break
        LOG.debug("noise, dark codes: iteration %d, deviance %.9g", iterations, best)
        # The squared step in units of sigma is twice what the likelihood can still gain.
        converged = bool(score[inside] @ step[inside] < 1e-3) or gained < 1e-4
    _, information = _score_and_information(pairs, values, known, free)
    information = _least(information, pairs, free)
    widen = np.sqrt(np.array([1.0, 1.0, 1.0, len(pairs), 1.0]))
    cov = inverse(information) * np.outer(widen, widen)
    return DarkFit(values, cov, _edge_gains(pairs, values, known), best, converged, iterations)


def _code_step(pair: DarkPair) -> float:
    return float(np.min(np.diff(pair.edges_DN)))


def _least(
    information: Float[np.ndarray, "5 5"], pairs: tuple[DarkPair, ...], free: np.ndarray
) -> Float[np.ndarray, "5 5"]:
    """What rounding hides is no larger than rounding: that much is known of codes that are all the same."""
    hidden = _code_step(pairs[0]) ** 2 / 12.0
    longest = max(max(pair.exposure_s for pair in pairs), 1e-9)
    least = np.array([1 / hidden, longest**2 / hidden, 1 / hidden**2, 1 / hidden**2, 1 / _SHAPE_SIGMA**2])
    found = information.copy()
    for i in np.flatnonzero(free & (np.diag(information) < least)):
        found[i, :] = found[:, i] = 0.0
        found[i, i] = least[i]
    return found


def inverse(information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Of a symmetric matrix of very unlike scales; rows and columns without information come back as zero."""
    root = np.sqrt(np.maximum(np.diag(information), 0.0))
    root = np.where(root > 1e-150, root, np.inf)
    outer = np.outer(root, root)
    return np.linalg.pinv(information / outer, rcond=1e-12, hermitian=True) / outer


def dark_levels(
    pairs: tuple[DarkPair, ...], fit: DarkFit, known: Surroundings
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Mean of each pair (censoring and rounding undone) and the variance of its temporal noise, row noise included.

    One scoring step per pair from the common fit; the offsets' share of the variance is the same in every pair and
    does not count here.
    """
    means, variances = [], []
    steps = _steps(pairs, fit.values)
    for pair in pairs:
        joint = _pair_probability(pair, fit.values, known)
        p = joint.ravel()
        moved = fit.values + np.array([steps[0], 0.0, 0.0, 0.0, 0.0])
        slope = (_pair_probability(pair, moved, known) - joint).ravel() / steps[0]
        total = float(pair.counts.sum())
        information = total * float((slope / p) @ slope)
        score = float(slope @ (pair.counts.ravel() / p))
        # Where all codes are one code, the level is known to rounding alone.
        blind = _code_step(pair) ** 2 / 12.0
        if information * blind < 1:
            means.append(fit.values[0] + fit.values[1] * pair.exposure_s)
            variances.append(blind)
            continue
        means.append(fit.values[0] + fit.values[1] * pair.exposure_s + score / information)
        temporal = max(1 / information - fit.values[3] / total, 0.05 / information)
        variances.append(temporal + known.sigma_row_DN**2 / (2 * pair.rows))
    return np.array(means), np.array(variances)


def _edge_gains(
    pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"], known: Surroundings
) -> Float[np.ndarray, " pairs"]:
    step = np.array([0.01 * np.sqrt(values[2]), 0.0, 0.0, 0.0, 0.0])
    gains = []
    for pair in pairs:
        rise = _pair_probability(pair, values + step, known) - _pair_probability(pair, values - step, known)
        gains.append(float(rise.sum(axis=1) @ centres_DN(pair) / (2 * step[0])))
    return np.array(gains)
