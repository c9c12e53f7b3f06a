"""Dark noise by maximum likelihood of integer codes: black, dark current, sigma, Tukey-lambda shape and DSNU at once.

The likelihood is that of the pair of codes one pixel gave in two frames, with the rounding inside it. Rounding is
therefore exact where the noise is a fraction of a code, and not the usual 1/12; and codes that stop at 0 or at the
converter's end are censored samples: they tell that the signal lies beyond, and no more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.iteration_log import LOG
from udccal.fitting.noise.codes import DarkPair, centres_DN
from udccal.fitting.noise.density import LEAST_SHAPE, MOST_SHAPE, NORMAL_SHAPE, dark_cdf

# Share of samples from anywhere in the window (hot and blinking pixels); keeps one outlier from deciding.
_BACKGROUND = 1e-5
# Prior on the shape, wide beside any real sensor's; it decides only where rounding hides the shape.
_SHAPE_SIGMA = 0.3
# Nodes of the offset's normal distribution: this far out, this many per width of the temporal noise.
_REACH, _NODES_PER_WIDTH, _FEWEST_NODES, _MOST_NODES = 5.5, 1.6, 13, 1201
PARAMETERS = ("black_DN", "dark_DN_per_s", "variance_DN2", "DSNU_DN2", "lambda_read")


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


def _nodes(spread: float, width: float) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
    """Offsets in DN and their weights: evenly spaced, which for a smooth integrand is as good as any quadrature."""
    wanted = 2 * _REACH * spread * _NODES_PER_WIDTH / max(width, 1e-9)
    number = int(np.clip(np.ceil(wanted), _FEWEST_NODES, _MOST_NODES)) | 1
    z = np.linspace(-_REACH, _REACH, number)
    weights = np.exp(-0.5 * z**2)
    return spread * z, weights / weights.sum()


def pair_probability(
    pair: DarkPair, values: Float[np.ndarray, "5"], known: Surroundings
) -> Float[np.ndarray, "codes codes"]:
    """Of the two codes of a pixel in a pair of dark frames; ``values`` in the order of ``PARAMETERS``."""
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
    likelihood = sum(float(np.sum(pair.counts * np.log(pair_probability(pair, values, known)))) for pair in pairs)
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
        rise = pair_probability(pair, moved, known) - at
        slopes.append(rise.ravel() / (moved[index] - values[index]))
    return np.stack(slopes)


def _score_and_information(
    pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"], known: Surroundings, free: np.ndarray
) -> tuple[Float[np.ndarray, "5"], Float[np.ndarray, "5 5"]]:
    steps = _steps(pairs, values)
    score, information = np.zeros(5), np.zeros((5, 5))
    for pair in pairs:
        joint = pair_probability(pair, values, known)
        slopes, p = _slopes(pair, joint, values, steps, known), joint.ravel()
        score += slopes @ (pair.counts.ravel() / p)
        information += float(pair.counts.sum()) * (slopes / p) @ slopes.T
    score[4] -= (values[4] - NORMAL_SHAPE) / _SHAPE_SIGMA**2
    information[4, 4] += 1 / _SHAPE_SIGMA**2
    return np.where(free, score, 0.0), np.where(np.outer(free, free), information, 0.0)


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
    converged, iterations, information = False, 0, np.zeros((5, 5))
    while not converged and iterations < max_iterations:
        iterations += 1
        score, information = _score_and_information(pairs, values, known, free)
        # At a bound with the score pointing outwards the bound is the answer.
        inside = free & ~((values <= _LOW) & (score < 0)) & ~((values >= _HIGH) & (score > 0))
        step = scaled_inverse(np.where(np.outer(inside, inside), information, 0.0)) @ np.where(inside, score, 0.0)
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
    # The last step was a small part of a sigma: the information is that before it.
    information = _least(information, pairs, free & _hidden(pairs, values))
    widen = np.sqrt(np.array([1.0, 1.0, 1.0, len(pairs), 1.0]))
    cov = scaled_inverse(information) * np.outer(widen, widen)
    return DarkFit(values, cov, _edge_gains(pairs, values, known), best, converged, iterations)


def _code_step(pair: DarkPair) -> float:
    return float(np.min(np.diff(pair.edges_DN)))


def _hidden(pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"]) -> bool:
    """Noise and offsets within a code: their number may then be hidden by rounding, and else by nothing but chance."""
    return bool(values[2] + values[3] < _code_step(pairs[0]) ** 2)


def _least(
    information: Float[np.ndarray, "5 5"], pairs: tuple[DarkPair, ...], hidden: np.ndarray
) -> Float[np.ndarray, "5 5"]:
    """What rounding hides is no larger than rounding: that much is known of codes that are all the same."""
    step2 = _code_step(pairs[0]) ** 2 / 12.0
    longest = max(max(pair.exposure_s for pair in pairs), 1e-9)
    least = np.array([1 / step2, longest**2 / step2, 1 / step2**2, 1 / step2**2, 1 / _SHAPE_SIGMA**2])
    found = information.copy()
    for i in np.flatnonzero(hidden & (np.diag(information) < least)):
        found[i, :] = found[:, i] = 0.0
        found[i, i] = least[i]
    return found


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
        joint = pair_probability(pair, fit.values, known)
        p = joint.ravel()
        moved = fit.values + np.array([steps[0], 0.0, 0.0, 0.0, 0.0])
        slope = (pair_probability(pair, moved, known) - joint).ravel() / steps[0]
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
        rise = pair_probability(pair, values + step, known) - pair_probability(pair, values - step, known)
        gains.append(float(rise.sum(axis=1) @ centres_DN(pair) / (2 * step[0])))
    return np.array(gains)
