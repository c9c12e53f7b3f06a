"""Dark frames: black and read noise; dark current, row noise and DSNU, each if the data support it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.misfit import excess_sigma
from udccal.fitting.engine.orders import Quantity
from udccal.fitting.noise.codes import (
    LOW,
    DarkFit,
    DarkPair,
    Five,
    excess_kurtosis,
    fit_dark,
    pair_probability,
    row_gain,
)
from udccal.fitting.noise.moments import NoiseMoments
from udccal.fitting.noise.patterns import Pattern, dsnu, row_noise

PerPair = Float[np.ndarray, " _"]


@final
@dataclass(frozen=True)
class DarkTerms:
    """Dark quantities; ``levels_cov`` is that of (black, dark current); ``white``: no pixel's mean shows rounding.

    ``foreign``: no distribution of the family describes the read noise; its variance is that of the codes. ``skewed``:
    none describes the mean code; black and dark current are those of the mean of all pixels. Black differs from
    exposure to exposure by ``unsteady_DN``, where that is more than noise.
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
    skewed: bool
    unsteady_DN: float
    fit: DarkFit
    offsets: Pattern


def fit_dark_terms(
    data: NoiseMoments, K_DN_per_e: float, start: Five | None = None, curvature: float = 0.0
) -> DarkTerms:
    """Fit all dark quantities; only the dark current's shot noise depends on ``K_DN_per_e``.

    ``curvature`` is the response's in 1/DN: dark signal bends as light does.
    """
    rules, stack, rounding = data.rules, data.dark_stack, data.rounding_DN2

    def fitted(row_DN: float, start: Five | None, normal: bool = False) -> DarkFit:
        return fit_dark(data.darks, K_DN_per_e, row_DN, rules, start, normal)

    row, in_pairs = row_noise(data, np.ones(len(data.darks)))
    fit = fitted(in_pairs, start)
    for _ in range(10):
        gains = np.array([row_gain(pair, fit.values, K_DN_per_e, in_pairs) for pair in data.darks])
        before, (row, in_pairs) = in_pairs, row_noise(data, gains)
        if abs(in_pairs**2 - before**2) <= 0.1 * row.variance**0.5:
            break
        # Each depends on the other in the opposite sense: half-way between is near to where both agree.
        in_pairs = float(np.sqrt(0.5 * (in_pairs**2 + before**2)))
        fit = fitted(in_pairs, fit.values)
    if float(fit.values[2]) + in_pairs**2 < (0.15 * data.q_DN) ** 2:
        # Temporal noise below 0.15 of a code cannot be distinguished from the pattern of rounding.
        row, unresolved = row_noise(data, np.zeros(len(data.darks)))[0], rounding
    else:
        unresolved = 0.0
    fit = _with_drawn_rows(fit, data, in_pairs)
    if in_pairs > 0 and np.abs(gains - 1).max() > rules.white:
        # Rounding hides part of the row noise, and what is wrong with it is taken for read noise.
        fit = fit.doubted(fitted(float(np.sqrt(max(in_pairs**2 - row.variance**0.5, 0.0))), fit.values).values)
    shape = Quantity(float(fit.values[4]), float(fit.cov[4, 4]))
    # Different offsets smear the rounding in the mean over all pixels; only a pixel's own noise smears its rounding.
    white = fit.follows and 4 * np.pi**2 * float(fit.values[2]) >= rules.smeared * data.q_DN**2
    if not white:
        # Coarse codes hardly show the distribution, and all that they tell but its shape depends on it.
        fit = fit.doubted(np.append(fitted(in_pairs, fit.values, True).values[:4], fit.values[4]))
        fit.cov[2, 2] += (0.5 * fit.values[2]) ** 2
    (_, rate, read, spread2, _), variance = fit.values.tolist(), float(fit.cov[2, 2])
    pairs = _means(data, fit, in_pairs**2 if white else None)
    read_DN2, shot = Quantity(read, variance), K_DN_per_e * max(rate, 0.0)
    drifts = (pairs.rate_DN_per_s if pairs.skewed else rate) * pairs.times_s + pairs.hot_DN
    expected = [read + rounding + K_DN_per_e * max(drift, 0.0) for drift in drifts]
    if not white:
        expected = _coded_variances(data.darks, fit, K_DN_per_e, in_pairs)
    more = unexplained_variance(data, expected, rules.most_hits)
    foreign = abs(more.value) > rules.foreign_sigma * more.variance**0.5
    if foreign:
        # Where rounding hides the distribution, half of what was not expected may be an effect of it, and what the
        # codes tell of the rest depends on the distribution as well.
        depends_on = 0.0 if white else 0.25 * more.value**2 + variance
        read_DN2 = Quantity(max(read + more.value, 0.0), more.variance + depends_on)
    elif read <= 1.001 * LOW[2]:
        read_DN2 = Quantity(0.0, max(variance, LOW[2] ** 2))
    # DSNU comes from the stack's average, or from the histograms where rounding biases the average.
    single = Quantity(read_DN2.value + shot * stack.exposure_s + rounding, read_DN2.variance)
    if seen := data.dark_seen:
        # Its own frames say what noise the average has, whatever the distribution.
        single = Quantity(seen.temporal_DN2, 2 * seen.temporal_DN2**2 / float(seen.dof.sum()))
    temporal = Quantity(single.value / stack.frames, single.variance / stack.frames**2)
    offsets = dsnu(stack.mean_DN, temporal, in_pairs**2 / stack.frames, rules.defect_sigma)
    if not white:
        pixels, sigma = stack.mean_DN.size, float(np.hypot(fit.cov[3, 3] ** 0.5, unresolved))
        offsets = replace(offsets, variance=spread2, sigma=sigma, samples=pixels)
    levels = _levels(data, fit, pairs, white, in_pairs**2, single.value, offsets, curvature)
    DSNU2 = Quantity.asked("DSNU", offsets.variance, offsets.sigma**2, offsets.samples)
    return DarkTerms(
        K_DN_per_e=K_DN_per_e,
        curvature=curvature,
        black_DN=levels.black_DN,
        dark_DN_per_s=levels.current,
        levels_cov=levels.cov,
        read_DN2=read_DN2,
        shape=shape,
        row_DN2=row,
        dsnu_DN2=DSNU2,
        white=white,
        foreign=foreign,
        skewed=pairs.skewed,
        unsteady_DN=levels.unsteady_DN,
        fit=fit,
        offsets=offsets,
    )


def _with_drawn_rows(fit: DarkFit, data: NoiseMoments, row_DN: float) -> DarkFit:
    """The fit with the error that a finite number of rows adds to its covariance.

    All samples of a row share one draw of its noise, and the draws of a few hundred rows have tails of their own. The
    fit, which takes them for normal, gives these to the read noise. Rows of two frames that agree by chance look like
    offsets of pixels; where there are none, rows that disagree look like less read noise.
    """
    rows, (_, _, read, spread2, shape), cov = sum(pair.rows for pair in data.darks), fit.values.tolist(), fit.cov.copy()
    cov[[2, 3], [2, 3]] += np.array([spread2 <= 1.001 * LOW[3], True]) * row_DN**4 / rows
    if cov[4, 4] > 0:
        slope = (excess_kurtosis(shape + 0.01) - excess_kurtosis(shape - 0.01)) / 0.02
        # The fourth cumulant of n normal draws has the variance 24 sigma^8 / n, and a pair has two of each row.
        error = min(float(np.sqrt(12 / rows)) * row_DN**4 / (abs(slope) * read**2), data.rules.shape_sigma)
        along = fit.cov[:, 4] / fit.cov[4, 4] * error
        cov += np.outer(along, along)
    return replace(fit, cov=cov)


def _coded_variances(pairs: tuple[DarkPair, ...], fit: DarkFit, K_DN_per_e: float, row_DN: float) -> list[float]:
    """Temporal variance without row noise that the fitted distribution has in each pair's codes."""
    found = []
    for pair in pairs:
        p, apart = pair_probability(pair, fit.values, K_DN_per_e, row_DN, 0.0), pair.differences_DN
        by_row = row_gain(pair, fit.values, K_DN_per_e, row_DN) * row_DN
        found.append(float(np.sum(p * apart**2)) / (2 * float(p.sum())) - by_row**2)
    return found


@final
@dataclass(frozen=True)
class _Line:
    """Black and dark current in DN per s: a line through the mean signals of exposures, of which ``left`` is the rest.

    One exposure time does not tell dark current from black: all is black.
    """

    values: PerPair
    cov: Float[np.ndarray, "2 2"]
    left: PerPair

    @classmethod
    def through(cls, means: PerPair, variances: PerPair, times: PerPair) -> _Line:
        """Fit it."""
        design = np.column_stack([np.ones_like(times), times * bool(np.ptp(times) > 0)])
        cov = scaled_inverse(design.T @ (design / variances[:, None]))
        values = cov @ (design.T @ (means / variances))
        return cls(values, cov, means - design @ values)


@final
@dataclass(frozen=True)
class _Means:
    """Mean signals of the dark pairs; ``skewed``: those of all pixels, as no distribution has them.

    Otherwise hot pixels outside the histograms have ``hot_DN`` of the mean of all pixels, and ``doubt`` is how far the
    mean codes would move black and dark current.
    """

    times_s: PerPair
    means_DN: PerPair
    variances_DN2: PerPair
    hot_DN: PerPair
    doubt: PerPair
    skewed: bool = False

    @property
    def rate_DN_per_s(self) -> float:
        """Dark current."""
        return float(_Line.through(self.means_DN, self.variances_DN2, self.times_s).values[1])


def _means(data: NoiseMoments, fit: DarkFit, row_DN2: float | None) -> _Means:
    """By the fit's distribution, unless mean codes are far off: read noise and dark current may have one tail.

    Without ``row_DN2``, mean codes do not tell: rounding bends them.
    """
    times = np.array([pair.exposure_s for pair in data.darks])
    fitted, nothing = (times, fit.means_DN, fit.variances_DN2), np.zeros(len(times))
    if row_DN2 is None:
        return _Means(*fitted, nothing, np.zeros(2))
    codes, dark = np.array([pair.mean_DN for pair in data.darks]), data.dark_moments
    everywhere = np.array([np.average(of.mean_DN, weights=of.samples) for of in dark])
    own = np.array([of.temporal_DN2 / (2 * of.pixels) + row_DN2 / (2 * of.height) for of in dark])
    by_codes = _Line.through(codes, own, times)
    doubt = by_codes.values - _Line.through(fit.means_DN, fit.variances_DN2, times).values
    if np.all(np.abs(doubt) <= data.rules.foreign_sigma * np.sqrt(np.diag(by_codes.cov))):
        return _Means(*fitted, everywhere - codes, doubt)
    own += [of.outlier_variance_DN2 / (2 * of.pixels) for of in dark]
    return _Means(times, everywhere, own, nothing, np.zeros(2), True)


@final
@dataclass(frozen=True)
class _Levels:
    """Black and dark current with their covariance, and ``DarkTerms.unsteady_DN``."""

    black_DN: float
    current: Quantity
    cov: Float[np.ndarray, "2 2"]
    unsteady_DN: float


def _levels(
    data: NoiseMoments,
    fit: DarkFit,
    pairs: _Means,
    white: bool,
    row_DN2: float,
    single_DN2: float,
    offsets: Pattern,
    curvature: float,
) -> _Levels:
    """Black and dark current from the mean of every dark exposure, with its own weight."""
    means, variances, times = pairs.means_DN, pairs.variances_DN2, pairs.times_s
    # The stack's mean is without hot pixels.
    if fit.follows and not pairs.skewed:
        stack = data.dark_stack
        means, times = np.append(means, offsets.mean), np.append(times, stack.exposure_s)
        rows = row_DN2 / len(stack.mean_DN)
        # Rounding of a pixel with little noise is nearly the same in every frame.
        own = single_DN2 / stack.frames + data.rounding_DN2 * float(np.exp(-4 * np.pi**2 * single_DN2 / data.q_DN**2))
        variances = np.append(variances, own / stack.mean_DN.size + rows / stack.frames)
    means = means + curvature * np.maximum(means - float(fit.values[0]), 0.0) ** 2
    line, apart, unsteady = _Line.through(means, variances, times), bool(np.ptp(times) > 0), 0.0
    if white:
        dof = float(len(times) - 1 - apart)
        unsteady = excess_sigma(line.left**2, variances, np.ones_like(means), dof)
        # A few exposures tell the scatter of black only roughly (Student's t).
        unsteady *= (dof / max(dof - 2, 1)) ** 0.5
        line = _Line.through(means, variances + unsteady**2, times)
    cov = line.cov + np.outer(pairs.doubt, pairs.doubt)
    # All of black may be dark current.
    cov[1, 1] = cov[1, 1] if apart else (line.values[0] / max(float(times[0]), 1e-6)) ** 2
    current = Quantity.asked("dark current", float(line.values[1]), float(cov[1, 1]), data.dark_samples)
    by_choice = current.variance - float(cov[1, 1])
    if not fit.follows:
        # With coarse or cut-off codes, the errors of black, spread and noise are common to all pairs.
        cov[[0, 1], [0, 1]] = np.maximum(np.diag(cov), np.diag(fit.cov)[:2] * [len(data.darks), 1])
    if any(own == pair.step_DN**2 / 12.0 for own, pair in zip(fit.variances_DN2, data.darks, strict=True)):
        # Rounding hides the same in every exposure.
        cov[0, 0] += data.rounding_DN2
    cov[1, 1] += by_choice
    # Black stays that of the line: a dark current too weak to be chosen must not shift it.
    return _Levels(float(line.values[0]), current, cov, unsteady)


def unexplained_variance(data: NoiseMoments, expected_DN2: Sequence[float], most_hits: float) -> Quantity:
    """Temporal variance of dark samples, without row noise, less that expected in each pair.

    It comes from the differences of the codes, and its sigma from their fourth moment. Differences taken for hits count
    where they are more than ``most_hits`` of all: radiation does not hit so often, so that they are tails of the noise,
    or pixels with random telegraph noise (EMVA 1288, clause 6.3, averages the variance over all pixels).
    """
    tails = sum(of.outliers for of in data.dark_moments) > most_hits * sum(of.pixels for of in data.dark_moments)
    values, variances = [], []
    for pair, of in zip(data.darks, data.dark_moments, strict=True):
        value = of.temporal_DN2 + tails * of.outlier_variance_DN2
        fourth = (np.sum(pair.counts * pair.differences_DN**4) + tails * of.outlier_powers[1]) / of.pixels
        values.append(value)
        variances.append(max(fourth / 4 - value**2, value**2) / of.pixels)
    weights = 1.0 / np.maximum(variances, 1e-30)
    return Quantity(float(np.average(np.subtract(values, expected_DN2), weights=weights)), float(1.0 / weights.sum()))
