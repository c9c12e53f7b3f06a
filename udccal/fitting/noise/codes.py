"""Dark noise by maximum likelihood of integer codes: black, dark current, sigma, its shape and DSNU at once.

The likelihood is that of the two codes of a pixel, with the rounding inside it. Rounding is therefore exact where the
noise is a fraction of a code, and not the usual
1/12; and codes that stop at 0 or at the converter's end are censored: they tell that the signal lies beyond, and no
more. Nothing is taken for normal that is not: few electrons of dark current are as skewed as Poisson says.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaln, xlogy

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.least_squares import Blocks, SolverRules, Step, minimise
from udccal.fitting.noise.data import DarkPair
from udccal.fitting.noise.rules import NoiseRules

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
PARAMETERS = ("black_DN", "dark_DN_per_s", "variance_DN2", "DSNU_DN2", "lambda_read")
# Variances at these are those of none: three hundredths of a code, a thousandth for the offsets.
LEAST_VARIANCE = 1e-3
_LOW = np.array([-np.inf, -np.inf, LEAST_VARIANCE, 1e-6, -0.1])
_BLACK = np.eye(5)[0]
_HIGH = np.array([np.inf, np.inf, np.inf, np.inf, 0.45])
# One-sided slopes promise a little for ever.
_SOLVER = SolverRules(least_gain=1e-3, stalled_gain=1e-4, iterations=40)


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


# Values in the order of ``PARAMETERS``.
Five = Float[np.ndarray, "5"]


@final
@dataclass(frozen=True)
class Surroundings:
    """What is known apart from the histograms: gain, row noise, and the share of samples from anywhere."""

    K_DN_per_e: float
    sigma_row_DN: float
    background: float


def pair_probability(pair: DarkPair, values: Five, known: Surroundings) -> Float[np.ndarray, "codes codes"]:
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


@final
@dataclass(frozen=True)
class DarkFit:
    """Values in the order of ``PARAMETERS``: variances of single samples without row noise.

    ``edge_gains`` is d(mean code)/d(black) per pair: 1 when rounding is white and no code is cut off.
    """

    values: Five
    cov: Float[np.ndarray, "5 5"]
    edge_gains: Float[np.ndarray, " pairs"]
    converged: bool


@final
@dataclass(frozen=True)
class _DarkCodes:
    """The engine's problem: the deviance of all histograms from those expected, the shape's prior added."""

    pairs: tuple[DarkPair, ...]
    known: Surroundings
    free: Bool[np.ndarray, "5"]
    shape_sigma: float
    name: str = "noise, dark codes"

    def equations_at(self, place: Five) -> Blocks:
        """Score and Fisher information; at a bound with the score pointing outwards the bound is the answer."""
        off = (place[4] - NORMAL_SHAPE) / self.shape_sigma
        cost, samples, steps = off**2, 0, _steps(self.pairs, place)
        score, information = np.zeros(5), np.zeros((5, 5))
        score[4], information[4, 4] = -off / self.shape_sigma, self.shape_sigma**-2
        for pair in self.pairs:
            joint = pair_probability(pair, place, self.known)
            p, counts, total = joint.ravel(), pair.counts.ravel(), int(pair.counts.sum())
            # One-sided: the second order, which that leaves, sums to nothing in the score at the truth.
            slopes = np.zeros((5, p.size))
            for i in np.flatnonzero(self.free):
                step = steps[i] if place[i] + steps[i] <= _HIGH[i] else -steps[i]
                slopes[i] = (pair_probability(pair, place + step * np.eye(5)[i], self.known).ravel() - p) / step
            cost += 2 * float(np.sum(xlogy(counts, counts / (total * p))))
            score += slopes @ (counts / p)
            information += total * (slopes / p) @ slopes.T
            samples += total
        information = np.where(np.outer(self.free, self.free), information, 0.0)
        held = ~self.free | ((place <= _LOW) & (score < 0)) | ((place >= _HIGH) & (score > 0))
        dense = Blocks.dense(cost, samples, information, np.where(self.free, score, 0.0))
        return replace(dense, held=held)

    def moved(self, place: Five, step: Step) -> Five:
        """Inside the bounds."""
        return np.clip(place + step.shared, _LOW, _HIGH)


def _steps(pairs: tuple[DarkPair, ...], values: Five) -> Five:
    """For slopes by differences: small beside the noise, large beside the arithmetic."""
    width = float(np.sqrt(values[2] + 0.01))
    longest = max(max(pair.exposure_s for pair in pairs), 1e-9)
    variance = 2e-3 * width**2
    return np.array([2e-3 * width, 2e-3 * width / longest, variance, max(1e-3 * values[3], 1e-4 * variance), 2e-3])


def start_values(pairs: tuple[DarkPair, ...]) -> Five:
    """Moments of the histograms: the covariance of the two codes is the variance of the offsets."""
    found = []
    for pair in pairs:
        centres, share = pair.centres_DN, pair.counts / max(pair.counts.sum(), 1)
        first, second = share.sum(axis=1), share.sum(axis=0)
        spread = float((centres - first @ centres) @ share @ (centres - second @ centres))
        total = float(first @ (centres - first @ centres) ** 2)
        found.append((pair.exposure_s, 0.5 * (first + second) @ centres, total - spread, spread))
    times, means, variances, spreads = np.array(found).T
    centred = times - times.mean()
    slope = float(centred @ means) / max(float(centred @ centred), 1e-300)
    black = float(means.mean()) - slope * float(times.mean())
    variance = max(float(variances.min()) - 1.0 / 12.0, 0.05)
    return np.array([black, slope, variance, max(float(spreads.min()), 0.003), NORMAL_SHAPE])


def fit_dark(
    pairs: tuple[DarkPair, ...], known: Surroundings, rules: NoiseRules, start: Five | None = None, normal: bool = False
) -> DarkFit:
    """Fisher scoring on the likelihood of all pairs.

    The pairs share their pixels' offsets, so the information on DSNU does not add up over pairs: its sigma is widened
    by the square root of their number. Row noise in ``known`` is that of the population; the mean levels that decide
    black and dark current carry their own weights (see ``dark_levels``).

    Args:
        pairs: the histograms.
        known: what is known besides.
        rules: for the prior of the shape.
        start: values to begin with; moments otherwise.
        normal: hold the shape at that of normal noise.
    """
    values = np.clip(start_values(pairs) if start is None else start, _LOW, _HIGH)
    one_exposure = len({pair.exposure_s for pair in pairs}) < 2
    free = np.array([True, not one_exposure, True, True, not normal])
    values = np.where(free, values, [0.0, 0.0, 0.0, 0.0, NORMAL_SHAPE])
    found = minimise(_DarkCodes(pairs, known, free, rules.shape_sigma), values, _SOLVER)
    values = found.place
    # Noise and offsets within a code: their number may then be hidden by rounding, and else by nothing but chance.
    hidden = free & bool(values[2] + values[3] < pairs[0].step_DN ** 2)
    widen = np.sqrt(np.array([1.0, 1.0, 1.0, len(pairs), 1.0]))
    cov = scaled_inverse(_least(found.equations.shared, pairs, hidden, rules)) * np.outer(widen, widen)
    return DarkFit(values, cov, _edge_gains(pairs, values, known), found.converged)


def _least(
    information: Float[np.ndarray, "5 5"], pairs: tuple[DarkPair, ...], hidden: Bool[np.ndarray, "5"], rules: NoiseRules
) -> Float[np.ndarray, "5 5"]:
    """What rounding hides is no larger than rounding: that much is known of codes that are all the same."""
    step2 = pairs[0].step_DN ** 2 / 12.0
    longest = max(max(pair.exposure_s for pair in pairs), 1e-9)
    least = np.array([1 / step2, longest**2 / step2, step2**-2, step2**-2, rules.shape_sigma**-2])
    lost = hidden & (np.diag(information) < least)
    return np.where(lost[:, None] | lost, np.diag(np.where(lost, least, 0.0)), information)


def dark_levels(
    pairs: tuple[DarkPair, ...], fit: DarkFit, known: Surroundings
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Mean of each pair (censoring and rounding undone) and the variance of its temporal noise, row noise included.

    One scoring step per pair from the common fit; the offsets' share of the variance is the same in every pair and
    does not count here.
    """
    means, variances = [], []
    step = _steps(pairs, fit.values)[0]
    for pair in pairs:
        joint = pair_probability(pair, fit.values, known)
        slope = (pair_probability(pair, fit.values + step * _BLACK, known) - joint).ravel() / step
        p, total = joint.ravel(), float(pair.counts.sum())
        information = total * float((slope / p) @ slope)
        # Where all codes are one code, the level is known to rounding alone.
        blind = pair.step_DN**2 / 12.0
        seen = information * blind >= 1
        shift = float(slope @ (pair.counts.ravel() / p)) / information if seen else 0.0
        means.append(fit.values[0] + fit.values[1] * pair.exposure_s + shift)
        temporal = max(1 / information - fit.values[3] / total, 0.05 / information) if seen else blind
        variances.append(temporal + known.sigma_row_DN**2 / (2 * pair.rows) if seen else blind)
    return np.array(means), np.array(variances)


def _edge_gains(pairs: tuple[DarkPair, ...], values: Five, known: Surroundings) -> Float[np.ndarray, " pairs"]:
    step = 0.01 * float(np.sqrt(values[2]))
    up, down = values + step * _BLACK, values - step * _BLACK
    rises = [pair_probability(pair, up, known) - pair_probability(pair, down, known) for pair in pairs]
    return np.array([rise.sum(axis=1) @ p.centres_DN for rise, p in zip(rises, pairs, strict=True)]) / (2 * step)
