"""The codes of dark pairs: their joint histograms, and the likelihood of these by the distribution of the read noise.

The likelihood is that of the two integer codes of a pixel: rounding is exact where the noise is a fraction of a code,
instead of the usual 1/12. Codes at 0 or at the converter's end are censored: the signal lies at or beyond them. Few
electrons of dark current are as skewed as Poisson's distribution. Read noise has a Tukey-lambda distribution.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import beta, xlogy

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.least_squares import Blocks, SolverRules, Step, minimise
from udccal.fitting.noise.data import Codes, NoiseRules, dark_window

# The shape with the kurtosis of a normal distribution.
NORMAL_SHAPE: Final = 0.1349
# Bounds of black [DN], dark current [DN/s], variance of single samples without row noise [DN^2], variance of the
# pixels' offsets [DN^2], and Tukey-lambda shape: the order of ``Five``. A variance at its lower bound counts as 0.
LOW = np.array([-np.inf, -np.inf, 1e-3, 1e-6, -0.1])
_HIGH = np.array([np.inf, np.inf, np.inf, np.inf, 0.45])
Five = Float[np.ndarray, "5"]
Grid = Float[np.ndarray, " grid"]
PerCode = Float[np.ndarray, "codes codes"]


@final
@dataclass(frozen=True)
class DarkPair:
    """A pair of dark frames reduced to the joint histogram of the two codes of each pixel, in groups of ``step_DN``.

    The outermost edges are infinite where the codes stop there (at 0, or at the converter's end).
    """

    exposure_s: float
    edges_DN: Float[np.ndarray, " codes_plus_1"]
    step_DN: float
    counts: Int[np.ndarray, "codes codes"]
    rows: int

    @property
    def centres_DN(self) -> Float[np.ndarray, " codes"]:
        """Middle of each group of codes."""
        return _centres(self.edges_DN, self.step_DN)

    @property
    def mean_DN(self) -> float:
        """Mean code of both frames."""
        both = self.counts.sum(axis=0) + self.counts.sum(axis=1)
        return float(both @ self.centres_DN) / float(both.sum())

    @property
    def differences_DN(self) -> PerCode:
        """First code less the second."""
        return np.asarray(self.centres_DN[:, None] - self.centres_DN)


def _centres(edges_DN: Float[np.ndarray, " edges"], step_DN: float) -> Float[np.ndarray, " codes"]:
    """Middle of each group of codes; that of a cut-off end is extrapolated from its neighbours."""
    edges = np.clip(edges_DN, edges_DN[1] - step_DN, edges_DN[-2] + step_DN)
    return np.asarray(0.5 * (edges[1:] + edges[:-1]))


def converter_step(counts: Int[np.ndarray, " codes"], least: int = 3) -> int | None:
    """Smallest step between the codes of a histogram: above 1 where a converter's bits are shifted up in 16 bits.

    None where fewer than ``least`` different codes occur.
    """
    codes = np.flatnonzero(counts)
    return int(np.gcd.reduce(np.diff(codes))) if codes.size >= least else None


def dark_pair(first: Codes, second: Codes, exposure_s: float, q_DN: int = 1, top_code: int = 65535) -> DarkPair:
    """Joint histogram over a window of codes around the median; codes beyond it are left out."""
    middle, half = dark_window(first, q_DN)
    # At most about 160 groups a side: a wide window loses nothing by coarser ones.
    group = max(1, int(np.ceil((2 * half + 1) / 160)))
    start = max(middle - half, 0)
    codes = min((middle + half - start) // group, (top_code // q_DN - start) // group) + 1
    # One more group takes all that lies outside the window.
    side = codes + 1
    group_of = (np.arange(65536) // q_DN - start) // group
    group_of = np.where((group_of >= 0) & (group_of < codes), group_of, codes).astype(np.uint16)
    both = group_of[first] * np.uint16(side) + group_of[second]
    joint = cv2.calcHist([both], [0], None, [side**2], [0, side**2]).astype(np.int64)
    counts = joint.reshape(side, side)[:codes, :codes]
    edges = (start + group * np.arange(codes + 1) - 0.5) * q_DN
    edges[0] = -np.inf if start == 0 else edges[0]
    edges[-1] = np.inf if edges[-1] >= top_code else edges[-1]
    return DarkPair(exposure_s, edges, float(group * q_DN), counts, len(first))


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


@functools.lru_cache(maxsize=128)
def _dark_cdf(sigma_DN: float, shape: float, row_DN: float, dark_DN: float, K_DN_per_e: float) -> tuple[Grid, Grid]:
    """Places (DN from the mean) and the probability that a dark sample lies below them before rounding.

    Tukey-lambda read noise, normal row noise and Poisson counts with the mean ``dark_DN`` are independent: their
    distribution is a convolution, computed as a product of spectra.
    """
    reach = 14 * np.sqrt(sigma_DN**2 + row_DN**2 + K_DN_per_e * max(dark_DN, 0.0)) + 2 * K_DN_per_e * (dark_DN > 0)
    # Peaks of single counts are as narrow as the read noise: three points per sigma of it, down to 0.02 DN.
    points = int(np.clip(2 ** np.ceil(np.log2(6 * reach / max(sigma_DN, 0.06))), 4096, 65536))
    step = 2 * reach / points
    edges = step * (np.arange(points + 1) - points // 2 - 0.5)
    grid, cdf = standard_cdf(shape)
    mass = np.diff(np.interp(edges / max(sigma_DN, 1e-12), grid, cdf, left=0.0, right=1.0))
    u = 2 * np.pi * np.fft.rfftfreq(points, step)
    # A distribution narrower than the grid would ring: it is widened to one step.
    smear = step if sigma_DN < 2 * step else 0.0
    log_phase = -0.5 * (row_DN**2 + smear**2) * u**2 + 0j
    if dark_DN > 0 and K_DN_per_e > 0:
        log_phase = log_phase + dark_DN / K_DN_per_e * (np.exp(-1j * u * K_DN_per_e) - 1 + 1j * u * K_DN_per_e)
    mass = np.fft.irfft(np.fft.rfft(mass) * np.exp(log_phase), points)
    return edges[1:], np.clip(np.maximum.accumulate(np.cumsum(mass)), 0.0, 1.0)


def pair_probability(pair: DarkPair, values: Five, K_DN_per_e: float, row_DN: float, background: float) -> PerCode:
    """Probability of the two codes of a pixel by groups of codes; ``background`` is NoiseRules'."""
    black, per_s, variance, spread2, shape = (float(v) for v in values)
    drift = per_s * pair.exposure_s
    grid, cdf = _dark_cdf(np.sqrt(variance), shape, row_DN, drift, K_DN_per_e)
    # Counts of dark current widen the distribution but leave its peaks as narrow as the read noise. For a smooth
    # integrand, evenly spaced nodes are as good as any quadrature.
    width, spread = max(np.sqrt(variance + row_DN**2), 1e-9), np.sqrt(spread2)
    z = np.linspace(-5.5, 5.5, int(np.clip(np.ceil(17.6 * spread / width), 13, 1201)) | 1)
    weights = np.exp(-0.5 * z**2)
    below = np.interp(pair.edges_DN - (black + drift + spread * z)[:, None], grid, cdf, left=0.0, right=1.0)
    single = np.diff(below, axis=1)
    joint = (single * (weights / weights.sum())[:, None]).T @ single
    return np.asarray((1 - background) * joint + background / joint.size)


def _mean_codes(pair: DarkPair, values: Five, K_DN_per_e: float, spread_DN: float, shifts_DN: Grid) -> Grid:
    """Mean codes of samples whose signals are shifted, with offsets and row noise of normal ``spread_DN``."""
    black, per_s, variance, _, shape = (float(v) for v in values)
    drift, edges, step = per_s * pair.exposure_s, pair.edges_DN, pair.step_DN
    # Of single codes, offsets widen the distribution as normal noise does.
    grid, cdf = _dark_cdf(float(np.sqrt(variance)), shape, spread_DN, drift, K_DN_per_e)
    # A window of codes cuts off tails, and may be narrower than offsets that grow with the exposure: groups are added
    # where no code is cut off, which is so where none lies at the end.
    mean, reach = black + drift, float(np.interp(1 - 1e-6, cdf, grid)) + float(np.abs(shifts_DN).max())
    below, above = (max(int(np.ceil((off + reach) / step)), 1) for off in (edges[1] - mean, mean - edges[-2]))
    whole = np.isfinite(edges[[0, -1]]) | (pair.counts.sum(axis=1)[[0, -1]] == 0)
    first = edges[1] - step * np.arange(below, 0, -1) if whole[0] else edges[:1]
    last = edges[-2] + step * np.arange(1, above + 1) if whole[1] else edges[-1:]
    edges = np.concatenate([first, edges[1:-1], last])
    lower = np.interp(edges - (mean + shifts_DN)[:, None], grid, cdf, left=0.0, right=1.0)
    return np.asarray(np.diff(lower, axis=1) @ _centres(edges, step))


def row_gain(pair: DarkPair, values: Five, K_DN_per_e: float, sigma_row_DN: float) -> float:
    """How much rows' mean codes scatter for row noise of 1 DN: 1 where rounding is white and no code is cut off.

    Mean codes follow the signal in steps that a pixel's noise and the offsets smear. Row noise that reaches over much
    of a code moves them by more or less than the slope at black says.
    """
    z = np.linspace(-4.0, 4.0, 33)
    shift, weights = max(sigma_row_DN, 0.01 * float(np.sqrt(values[2]))) * z, np.exp(-0.5 * z**2)
    means = _mean_codes(pair, values, K_DN_per_e, float(np.sqrt(values[3])), shift)
    scatter, own = (float(np.cov(of, aweights=weights, ddof=0)) for of in (means, shift))
    return float(np.sqrt(scatter / own))


@final
@dataclass(frozen=True)
class DarkFit:
    """Values in the order of the bounds, with their covariance, and numbers of each pair.

    ``edge_gains`` is d(mean code)/d(black): 1, and ``follows``, where rounding is white and no code is cut off.
    ``means_DN`` is the mean signal with rounding and censoring undone, of variance ``variances_DN2``.
    """

    values: Five
    cov: Float[np.ndarray, "5 5"]
    converged: bool
    follows: bool
    edge_gains: Float[np.ndarray, " pairs"]
    means_DN: Float[np.ndarray, " pairs"]
    variances_DN2: Float[np.ndarray, " pairs"]

    def doubted(self, others: Five) -> DarkFit:
        """The fit where the data do not tell its values from ``others``: the difference is one more error."""
        return replace(self, cov=self.cov + np.outer(others - self.values, others - self.values))


@final
@dataclass(frozen=True)
class _DarkCodes:
    """The solver's problem: the deviance of all histograms from those expected, and the shape's prior."""

    pairs: tuple[DarkPair, ...]
    K_DN_per_e: float
    sigma_row_DN: float
    rules: NoiseRules
    free: Bool[np.ndarray, "5"]
    longest_s: float
    name: str = "noise, dark codes"

    def expected(self, pair: DarkPair, place: Five) -> PerCode:
        return pair_probability(pair, place, self.K_DN_per_e, self.sigma_row_DN, self.rules.background)

    def equations_at(self, place: Five) -> Blocks:
        """Score and Fisher information; a parameter at a bound stays there while its score points outwards."""
        off = (place[4] - NORMAL_SHAPE) / self.rules.shape_sigma
        cost, samples, shape = off**2, 0, self.free[4] * np.eye(5)[4] / self.rules.shape_sigma
        score, information = -off * shape, np.outer(shape, shape)
        # Steps of differences: small compared with the noise, large compared with rounding errors.
        width2 = place[2] + 0.01
        width, offsets = width2**0.5, max(0.5 * place[3], 1e-4 * width2)
        steps = 2e-3 * np.array([width, width / self.longest_s, width2, offsets, 1.0])
        steps = np.where(place + steps <= _HIGH, steps, -steps)
        for pair in self.pairs:
            p, counts = self.expected(pair, place).ravel(), pair.counts.ravel()
            total = int(counts.sum())
            # One-sided: the second order, which remains, sums to zero in the score at the truth.
            jacobian = np.zeros((5, p.size))
            for i in np.flatnonzero(self.free):
                jacobian[i] = (self.expected(pair, place + steps[i] * np.eye(5)[i]).ravel() - p) / steps[i]
            cost += 2 * float(np.sum(xlogy(counts, counts / (total * p))))
            score += jacobian @ (counts / p)
            information += total * (jacobian / p) @ jacobian.T
            samples += total
        held = ~self.free | ((place <= LOW) & (score < 0)) | ((place >= _HIGH) & (score > 0))
        return replace(Blocks.dense(cost, samples, information, score), held=held)

    def moved(self, place: Five, step: Step) -> Five:
        """The place after a step, inside the bounds."""
        return np.clip(place + step.shared, LOW, _HIGH)

    def level(self, pair: DarkPair, values: Five) -> tuple[float, float, float]:
        """``DarkFit.edge_gains``, ``means_DN`` and ``variances_DN2`` of a pair, by one scoring step from the fit."""
        black = 0.01 * float(np.sqrt(values[2])) * np.eye(5)[0]
        up, down = (self.expected(pair, values + sign * black) for sign in (1, -1))
        by_black, p, total = (up - down) / (2 * black[0]), 0.5 * (up + down), float(pair.counts.sum())
        spread = float(np.sqrt(values[3] + self.sigma_row_DN**2))
        means = _mean_codes(pair, values, self.K_DN_per_e, spread, black[0] * np.array([-1.0, 1.0]))
        gain, information = float(np.ptp(means) / (2 * black[0])), total * float(np.sum(by_black**2 / p))
        mean, blind = float(values[0] + values[1] * pair.exposure_s), pair.step_DN**2 / 12.0
        if information * blind < 1:
            return gain, mean, blind  # Where all samples have one code, the level is known to within rounding.
        shift = float(np.sum(by_black * pair.counts / p)) / information
        # The offsets' part of the variance is the same in every pair and does not count here.
        temporal = max(1 / information - float(values[3]) / total, 0.05 / information)
        return gain, mean + shift, temporal + self.sigma_row_DN**2 / (2 * pair.rows)


def start_values(pairs: tuple[DarkPair, ...]) -> Five:
    """Start values from moments of the histograms: the covariance of the two codes is the offsets' variance."""
    moments = []
    for pair in pairs:
        centres, part = pair.centres_DN, pair.counts / max(pair.counts.sum(), 1)
        first, second = part.sum(axis=1), part.sum(axis=0)
        spread = float((centres - first @ centres) @ part @ (centres - second @ centres))
        total = float(first @ (centres - first @ centres) ** 2)
        moments.append((pair.exposure_s, 0.5 * (first + second) @ centres, total - spread, spread))
    times, means, variances, spreads = np.array(moments).T
    rate, black = np.polyfit(times, means, 1) if np.ptp(times) > 0 else (0.0, means.mean())
    return np.array([black, rate, max(variances.min() - 1 / 12, 0.05), max(spreads.min(), 0.003), NORMAL_SHAPE])


def fit_dark(
    pairs: tuple[DarkPair, ...], K_DN_per_e: float, sigma_row_DN: float, rules: NoiseRules, start: Five | None = None,
    normal: bool = False,
) -> DarkFit:  # fmt: skip
    """Fisher scoring on the likelihood of all pairs; ``normal`` holds the shape at that of normal noise.

    The pairs have their pixels' offsets in common, so the information on DSNU does not add up over pairs: its sigma is
    widened by the square root of their number. Row noise is that of these frames.
    """
    values = np.clip(start_values(pairs) if start is None else start, LOW, _HIGH)
    free = np.array([True, len({pair.exposure_s for pair in pairs}) > 1, True, True, not normal])
    values = np.where(free, values, [0.0, 0.0, 0.0, 0.0, NORMAL_SHAPE])
    longest_s = max(*(pair.exposure_s for pair in pairs), 1e-9)
    problem = _DarkCodes(pairs, K_DN_per_e, sigma_row_DN, rules, free, longest_s)
    # One-sided derivatives predict a small gain for ever.
    found = minimise(problem, values, SolverRules(least_gain=1e-3, stalled_gain=1e-4))
    values, information = found.place, found.equations.shared
    # Rounding hides no more than its own size: codes that are all the same give this bound. Noise and offsets within a
    # code may be hidden by rounding, and otherwise only by chance.
    step2 = pairs[0].step_DN ** 2 / 12.0
    least = np.array([1 / step2, longest_s**2 / step2, step2**-2, step2**-2, rules.shape_sigma**-2])
    lost = free & bool(values[2] + values[3] < 12 * step2) & (np.diag(information) < least)
    information = np.where(lost[:, None] | lost, np.diag(np.where(lost, least, 0.0)), information)
    widen = np.sqrt([1.0, 1.0, 1.0, len(pairs), 1.0])
    inverse = scaled_inverse(information)
    cov = found.with_rest(inverse * np.outer(widen, widen))
    # The mean of its rows moves all codes of a pair, which coarse codes take for another shape: a step from black that
    # is off in one pair has this pair's information as its right side.
    alone = [replace(problem, pairs=(pair,)).equations_at(values).shared[0] for pair in pairs]
    by_rows = sigma_row_DN / np.sqrt([[2 * pair.rows] for pair in pairs]) * alone @ inverse
    cov += by_rows.T @ by_rows
    levels = np.array([problem.level(pair, values) for pair in pairs]).T
    return DarkFit(values, cov, found.converged, bool(np.abs(levels[0] - 1).max() < rules.white), *levels)
