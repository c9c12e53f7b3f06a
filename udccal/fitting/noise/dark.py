"""Dark frames: black, dark current, read noise and its shape, row noise and DSNU; each if the data support it.

The likelihood is that of the two integer codes of a pixel: rounding is exact where the noise is a fraction of a code,
instead of the usual 1/12. Codes at 0 or at the converter's end are censored: the signal lies at or beyond them. Few
electrons of dark current are as skewed as Poisson's distribution.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import xlogy

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.least_squares import Blocks, SolverRules, Step, minimise
from udccal.fitting.engine.orders import Quantity
from udccal.fitting.noise.data import NoiseRules
from udccal.fitting.noise.moments import DarkPair, NoiseMoments
from udccal.fitting.noise.patterns import Pattern, dsnu, row_noise
from udccal.fitting.noise.read_noise import NORMAL_SHAPE, standard_cdf, unexplained_variance

# Bounds of black [DN], dark current [DN/s], variance of single samples without row noise [DN^2], variance of the
# pixels' offsets [DN^2], and Tukey-lambda shape: the order of ``Five``. A variance at its lower bound counts as 0.
_LOW = np.array([-np.inf, -np.inf, 1e-3, 1e-6, -0.1])
_HIGH = np.array([np.inf, np.inf, np.inf, np.inf, 0.45])
Five = Float[np.ndarray, "5"]
Grid = Float[np.ndarray, " grid"]
Expected = Callable[[DarkPair, Five], Float[np.ndarray, "codes codes"]]


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


def pair_probability(
    pair: DarkPair, values: Five, K_DN_per_e: float, sigma_row_DN: float, background: float
) -> Float[np.ndarray, "codes codes"]:
    """Probability of the two codes of a pixel by groups of codes; ``background`` is NoiseRules'."""
    black, per_s, variance, spread2, shape = (float(v) for v in values)
    drift = per_s * pair.exposure_s
    grid, cdf = _dark_cdf(np.sqrt(variance), shape, sigma_row_DN, drift, K_DN_per_e)
    # Counts of dark current widen the distribution but leave its peaks as narrow as the read noise. For a smooth
    # integrand, evenly spaced nodes are as good as any quadrature.
    width, spread = max(np.sqrt(variance + sigma_row_DN**2), 1e-9), np.sqrt(spread2)
    z = np.linspace(-5.5, 5.5, int(np.clip(np.ceil(17.6 * spread / width), 13, 1201)) | 1)
    weights = np.exp(-0.5 * z**2)
    below = np.interp(pair.edges_DN - (black + drift + spread * z)[:, None], grid, cdf, left=0.0, right=1.0)
    single = np.diff(below, axis=1)
    joint = (single * (weights / weights.sum())[:, None]).T @ single
    return np.asarray((1 - background) * joint + background / joint.size)


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


@final
@dataclass(frozen=True)
class _DarkCodes:
    """The solver's problem: the deviance of all histograms from those expected, and the shape's prior."""

    pairs: tuple[DarkPair, ...]
    expected: Expected
    free: Bool[np.ndarray, "5"]
    shape_sigma: float
    name: str = "noise, dark codes"

    def equations_at(self, place: Five) -> Blocks:
        """Score and Fisher information; a parameter at a bound stays there while its score points outwards."""
        off = (place[4] - NORMAL_SHAPE) / self.shape_sigma
        cost, samples, shape = off**2, 0, self.free[4] * np.eye(5)[4] / self.shape_sigma
        score, information = -off * shape, np.outer(shape, shape)
        # Steps of differences: small compared with the noise, large compared with rounding errors.
        width2 = place[2] + 0.01
        longest = max(max(pair.exposure_s for pair in self.pairs), 1e-9)
        steps = 2e-3 * np.array([width2**0.5, width2**0.5 / longest, width2, max(0.5 * place[3], 1e-4 * width2), 1.0])
        steps = np.where(place + steps <= _HIGH, steps, -steps)
        for pair in self.pairs:
            p, counts = self.expected(pair, place).ravel(), pair.counts.ravel()
            total = int(counts.sum())
            # One-sided: the second order, which remains, sums to zero in the score at the truth.
            jacobian = np.zeros((5, p.size))
            for i in np.flatnonzero(self.free):
                moved = self.expected(pair, place + steps[i] * np.eye(5)[i])
                jacobian[i] = (moved.ravel() - p) / steps[i]
            cost += 2 * float(np.sum(xlogy(counts, counts / (total * p))))
            score += jacobian @ (counts / p)
            information += total * (jacobian / p) @ jacobian.T
            samples += total
        held = ~self.free | ((place <= _LOW) & (score < 0)) | ((place >= _HIGH) & (score > 0))
        return replace(Blocks.dense(cost, samples, information, score), held=held)

    def moved(self, place: Five, step: Step) -> Five:
        """The place after a step, inside the bounds."""
        return np.clip(place + step.shared, _LOW, _HIGH)


def start_values(pairs: tuple[DarkPair, ...]) -> Five:
    """Start values from moments of the histograms: the covariance of the two codes is the offsets' variance."""
    found = []
    for pair in pairs:
        centres, part = pair.centres_DN, pair.counts / max(pair.counts.sum(), 1)
        first, second = part.sum(axis=1), part.sum(axis=0)
        spread = float((centres - first @ centres) @ part @ (centres - second @ centres))
        total = float(first @ (centres - first @ centres) ** 2)
        found.append((pair.exposure_s, 0.5 * (first + second) @ centres, total - spread, spread))
    times, means, variances, spreads = np.array(found).T
    centred = times - times.mean()
    slope = centred @ means / (centred @ centred) if np.ptp(times) > 0 else 0.0
    least = max(variances.min() - 1.0 / 12.0, 0.05), max(spreads.min(), 0.003)
    return np.array([means.mean() - slope * times.mean(), slope, *least, NORMAL_SHAPE])


def fit_dark(
    pairs: tuple[DarkPair, ...], K_DN_per_e: float, sigma_row_DN: float, rules: NoiseRules, start: Five | None = None,
    normal: bool = False,
) -> DarkFit:  # fmt: skip
    """Fisher scoring on the likelihood of all pairs; ``normal`` holds the shape at that of normal noise.

    The pairs have their pixels' offsets in common, so the information on DSNU does not add up over pairs: its sigma is
    widened by the square root of their number. Row noise is that of these frames.
    """
    values = np.clip(start_values(pairs) if start is None else start, _LOW, _HIGH)
    free = np.array([True, len({pair.exposure_s for pair in pairs}) > 1, True, True, not normal])
    values = np.where(free, values, [0.0, 0.0, 0.0, 0.0, NORMAL_SHAPE])
    # One-sided derivatives predict a small gain for ever.
    solver = SolverRules(least_gain=1e-3, stalled_gain=1e-4)

    def expected(pair: DarkPair, at: Five) -> Float[np.ndarray, "codes codes"]:
        return pair_probability(pair, at, K_DN_per_e, sigma_row_DN, rules.background)

    found = minimise(_DarkCodes(pairs, expected, free, rules.shape_sigma), values, solver)
    values, information = found.place, found.equations.shared
    # Rounding hides no more than its own size: codes that are all the same give this bound. Noise and offsets within a
    # code may be hidden by rounding, and otherwise only by chance.
    step2, longest = pairs[0].step_DN ** 2 / 12.0, max(max(pair.exposure_s for pair in pairs), 1e-9)
    least = np.array([1 / step2, longest**2 / step2, step2**-2, step2**-2, rules.shape_sigma**-2])
    lost = free & bool(values[2] + values[3] < 12 * step2) & (np.diag(information) < least)
    information = np.where(lost[:, None] | lost, np.diag(np.where(lost, least, 0.0)), information)
    widen = np.sqrt(np.array([1.0, 1.0, 1.0, len(pairs), 1.0]))
    cov = found.with_rest(scaled_inverse(information) * np.outer(widen, widen), found.equations.step(0.0).shared)
    levels = np.array([_level(pair, values, expected, sigma_row_DN) for pair in pairs]).T
    return DarkFit(values, cov, found.converged, bool(np.abs(levels[0] - 1).max() < rules.white), *levels)


def _level(pair: DarkPair, values: Five, expected: Expected, sigma_row_DN: float) -> tuple[float, float, float]:
    """``DarkFit.edge_gains``, ``means_DN`` and ``variances_DN2`` of a pair, by one scoring step from the common fit."""
    black = 0.01 * float(np.sqrt(values[2])) * np.eye(5)[0]
    up, down = (expected(pair, values + sign * black) for sign in (1, -1))
    by_black, p, total = (up - down) / (2 * black[0]), 0.5 * (up + down), float(pair.counts.sum())
    gain, information = float(by_black.sum(axis=1) @ pair.centres_DN), total * float(np.sum(by_black**2 / p))
    mean, blind = float(values[0] + values[1] * pair.exposure_s), pair.step_DN**2 / 12.0
    if information * blind < 1:
        return gain, mean, blind  # Where all samples have one code, the level is known to within rounding.
    shift = float(np.sum(by_black * pair.counts / p)) / information
    # The offsets' part of the variance is the same in every pair and does not count here.
    temporal = max(1 / information - float(values[3]) / total, 0.05 / information)
    return gain, mean + shift, temporal + sigma_row_DN**2 / (2 * pair.rows)


@final
@dataclass(frozen=True)
class DarkTerms:
    """Dark quantities; ``levels_cov`` is that of (black, dark current); ``white``: no pixel's mean shows rounding.

    ``foreign``: no distribution of the family describes the read noise; its variance is that of the codes.
    """

    K_DN_per_e: float
    curvature: float
    black_DN: float
    dark_DN_per_s: Quantity
    levels_cov: Float[np.ndarray, "2 2"]
    read_DN2: Quantity
    shape: Quantity
    row_DN2: Quantity
    dsnu_DN2: Quantity
    white: bool
    foreign: bool
    fit: DarkFit
    offsets: Pattern


def fit_dark_terms(
    data: NoiseMoments, K_DN_per_e: float, start: Five | None = None, curvature: float = 0.0
) -> DarkTerms:
    """Fit all dark quantities; only the dark current's shot noise depends on ``K_DN_per_e``.

    ``curvature`` is the response's in 1/DN: dark signal bends as light does.
    """
    rules = data.rules
    row, in_pairs = row_noise(data, np.ones(len(data.darks)))
    fit = fit_dark(data.darks, K_DN_per_e, in_pairs, rules, start)
    if not fit.follows:
        row, in_pairs = row_noise(data, fit.edge_gains)
        fit = fit_dark(data.darks, K_DN_per_e, in_pairs, rules, fit.values)
    # Temporal noise below 0.15 of a code cannot be distinguished from the pattern of rounding.
    resolved = float(fit.values[2]) + in_pairs**2 >= (0.15 * data.q_DN) ** 2
    row = row if resolved else row_noise(data, np.zeros(len(data.darks)))[0]
    value, variance = float(fit.values[4]), float(fit.cov[4, 4])
    name, gain = f"read noise of another shape than normal ({NORMAL_SHAPE:.2f})", (value - NORMAL_SHAPE) ** 2 / variance
    shape = Quantity.asked(name, value, variance, data.dark_samples, gain, without=NORMAL_SHAPE)
    free, normal = fit, fit_dark(data.darks, K_DN_per_e, in_pairs, rules, fit.values, True)
    fit = free if shape.there else normal
    # Different offsets smear the rounding in the mean over all pixels; only a pixel's own noise smears its rounding.
    white = fit.follows and 4 * np.pi**2 * float(fit.values[2]) >= rules.smeared * data.q_DN**2
    if not white:
        # Coarse codes hardly show the distribution, and all that they tell depends on it.
        depends = (free.values - normal.values) * np.array([1.0, 1.0, 1.0, 1.0, 0.0])
        fit = replace(fit, cov=fit.cov + np.outer(depends, depends))
        fit.cov[2, 2] += (0.5 * fit.values[2]) ** 2
        row = replace(row, variance=row.variance + (0.5 * row.value) ** 2)
    spread2, variance = float(fit.values[3]), float(fit.cov[2, 2])
    read_DN2 = Quantity(float(fit.values[2]), variance)
    rate, rounding, stack = max(float(fit.values[1]), 0.0), data.q_DN**2 / 12.0, data.dark_stack
    if white:
        expected = [read_DN2.value + rounding + K_DN_per_e * rate * pair.exposure_s for pair in data.darks]
    else:
        expected = _coded_variances(data.darks, fit, K_DN_per_e, in_pairs)
    more = unexplained_variance(data, expected, rules.most_hits)
    foreign = abs(more.value) > rules.foreign_sigma * more.variance**0.5
    if foreign:
        # Where rounding hides the distribution, half of what was not expected may be an effect of it, and what the
        # codes tell of the rest depends on the distribution as well.
        value = max(read_DN2.value + more.value, 0.0)
        read_DN2 = Quantity(value, more.variance + (0.0 if white else 0.25 * more.value**2 + variance))
    elif read_DN2.value <= 1.001 * _LOW[2]:
        read_DN2 = Quantity(0.0, max(variance, _LOW[2] ** 2))
    # DSNU comes from the stack's average, or from the histograms where rounding biases the average.
    single = read_DN2.value + K_DN_per_e * rate * stack.exposure_s + rounding
    if foreign and data.dark_seen is not None:
        single = float(np.average(data.dark_seen.variance_DN2, weights=data.dark_seen.dof))
    offsets = dsnu(stack.mean_DN, single / stack.frames, in_pairs**2 / stack.frames, rules.defect_sigma)
    if not white:
        pixels, sigma = stack.mean_DN.size, float(np.hypot(fit.cov[3, 3] ** 0.5, 0.0 if resolved else rounding))
        offsets = replace(offsets, variance=spread2, sigma=sigma, samples=pixels, mean_variance=spread2 / pixels)
    black, levels_cov, current = _levels(data, fit, in_pairs**2, single, offsets, curvature)
    DSNU2 = Quantity.asked("DSNU", offsets.variance, offsets.sigma**2, offsets.samples)
    return DarkTerms(
        K_DN_per_e, curvature, black, current, levels_cov, read_DN2, shape, row, DSNU2, white, foreign, fit, offsets
    )


def _coded_variances(pairs: tuple[DarkPair, ...], fit: DarkFit, K_DN_per_e: float, row_DN: float) -> list[float]:
    """Temporal variance without row noise that the fitted distribution has in each pair's codes."""
    found = []
    for pair, gain in zip(pairs, fit.edge_gains, strict=True):
        p = pair_probability(pair, fit.values, K_DN_per_e, row_DN, 0.0)
        square = (pair.centres_DN[:, None] - pair.centres_DN) ** 2
        found.append(float(np.sum(p * square)) / (2 * float(p.sum())) - (float(gain) * row_DN) ** 2)
    return found


def _levels(
    data: NoiseMoments, fit: DarkFit, row_DN2: float, single_DN2: float, offsets: Pattern, curvature: float
) -> tuple[float, Float[np.ndarray, "2 2"], Quantity]:
    """Black and dark current from the mean of every dark exposure, with its own weight."""
    means, variances, times = fit.means_DN, fit.variances_DN2, np.array([pair.exposure_s for pair in data.darks])
    stack, rounding = data.dark_stack, data.q_DN**2 / 12.0
    if fit.follows:
        means, times = np.append(means, offsets.mean), np.append(times, stack.exposure_s)
        rows = row_DN2 / len(stack.mean_DN)
        variances = np.append(variances, (single_DN2 / stack.mean_DN.size + rows) / stack.frames)
    above = np.maximum(means - float(fit.values[0]), 0.0)
    means = means + curvature * above**2
    # One exposure time does not tell dark current from black: all is black, and all of it may be dark current.
    apart = bool(np.ptp(times) > 0)
    design = np.column_stack([np.ones_like(times), times * apart])
    cov = scaled_inverse(design.T @ (design / variances[:, None]))
    line = cov @ (design.T @ (means / variances))
    cov[1, 1] = cov[1, 1] if apart else (line[0] / max(float(times[0]), 1e-6)) ** 2
    current = Quantity.asked("dark current", float(line[1]), float(cov[1, 1]), data.dark_samples)
    # The offsets of this sensor's pixels are one draw: their mean is not that of all sensors alike.
    cov[0, 0] += offsets.mean_variance
    if not fit.follows:
        # With coarse or cut-off codes, the errors of black, spread and noise are common to all pairs.
        cov[0, 0] = max(float(cov[0, 0]), len(data.darks) * float(fit.cov[0, 0]))
        cov[1, 1] = max(float(cov[1, 1]), float(fit.cov[1, 1]))
    if any(own == pair.step_DN**2 / 12.0 for own, pair in zip(fit.variances_DN2, data.darks, strict=True)):
        # Rounding hides the same in every exposure.
        cov[0, 0] += rounding
    # Black stays that of the line: a dark current too weak to be chosen must not shift it.
    return float(line[0]), cov, current
