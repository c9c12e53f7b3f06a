"""Dark frames: black and read noise; dark current, row noise and DSNU, each if the data support it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

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
from udccal.fitting.noise.dark_levels import Means, PerPair, dark_levels, dark_means
from udccal.fitting.noise.moments import NoiseMoments
from udccal.fitting.noise.patterns import Pattern, dsnu, row_noise


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
    codes = _fit_codes(data, K_DN_per_e, start)
    fit, row_DN2 = codes.fit, codes.row_DN**2
    pairs = dark_means(data, fit, row_DN2 if codes.white else None)
    read, foreign = _read_noise(data, codes, pairs, K_DN_per_e)
    # Of one frame of the stack.
    shot = K_DN_per_e * max(float(fit.values[1]), 0.0) * data.dark_stack.exposure_s
    single = Quantity(read.value + shot + data.rounding_DN2, read.variance)
    if seen := data.dark_seen:
        # Its own frames say what noise the average has, whatever the distribution.
        single = Quantity(seen.near_DN2, 2 * seen.near_DN2**2 / float(seen.dof.sum()))
    offsets = _offsets(data, codes, single)
    levels = dark_levels(data, fit, pairs, codes.white, row_DN2, single.value, offsets, curvature)
    return DarkTerms(
        K_DN_per_e=K_DN_per_e,
        curvature=curvature,
        black_DN=levels.black_DN,
        dark_DN_per_s=levels.current,
        levels_cov=levels.cov,
        read_DN2=read,
        shape=Quantity(float(fit.values[4]), float(fit.cov[4, 4])),
        row_DN2=codes.row,
        dsnu_DN2=Quantity.asked("DSNU", offsets.variance, offsets.sigma**2, offsets.samples),
        white=codes.white,
        foreign=foreign,
        skewed=pairs.skewed,
        unsteady_DN=levels.unsteady_DN,
        fit=fit,
        offsets=offsets,
    )


@final
@dataclass(frozen=True)
class _Codes:
    """The fit of the dark codes, and the row noise that agrees with it: ``row_DN`` is that of the pairs alone.

    ``unresolved_DN2`` is the row noise that rounding may hide; ``white`` as in ``DarkTerms``.
    """

    fit: DarkFit
    row: Quantity
    row_DN: float
    unresolved_DN2: float
    white: bool


def _fit_codes(data: NoiseMoments, K_DN_per_e: float, start: Five | None) -> _Codes:
    """Fit the codes and the row noise by turns: each needs the other."""
    rules, unresolved = data.rules, 0.0

    def fitted(row_DN: float, start: Five | None, normal: bool = False) -> DarkFit:
        return fit_dark(data.darks, K_DN_per_e, row_DN, rules, start, normal)

    row, row_DN = row_noise(data, np.ones(len(data.darks)))
    fit = fitted(row_DN, start)
    for _ in range(10):
        gains = np.array([row_gain(pair, fit.values, K_DN_per_e, row_DN) for pair in data.darks])
        before, (row, row_DN) = row_DN, row_noise(data, gains)
        if abs(row_DN**2 - before**2) <= 0.1 * row.variance**0.5:
            break
        # Each depends on the other in the opposite sense: half-way between is near to where both agree.
        row_DN = float(np.sqrt(0.5 * (row_DN**2 + before**2)))
        fit = fitted(row_DN, fit.values)
    if float(fit.values[2]) + row_DN**2 < (0.15 * data.q_DN) ** 2:
        # Temporal noise below 0.15 of a code cannot be distinguished from the pattern of rounding.
        row, unresolved = row_noise(data, np.zeros(len(data.darks)))[0], data.rounding_DN2
    fit = _with_drawn_rows(fit, data, row_DN)
    if row_DN > 0 and np.abs(gains - 1).max() > rules.white:
        # Rounding hides part of the row noise, and what is wrong with it is taken for read noise.
        fit = fit.doubted(fitted(float(np.sqrt(max(row_DN**2 - row.variance**0.5, 0.0))), fit.values).values)
    # Different offsets smear the rounding in the mean over all pixels; only a pixel's own noise smears its rounding.
    white = fit.follows and 4 * np.pi**2 * float(fit.values[2]) >= rules.smeared * data.q_DN**2
    if not white:
        # Coarse codes hardly show the distribution, and all that they tell but its shape depends on it.
        fit = fit.doubted(np.append(fitted(row_DN, fit.values, True).values[:4], fit.values[4]))
        fit.cov[2, 2] += (0.5 * fit.values[2]) ** 2
    return _Codes(fit, row, row_DN, unresolved, white)


def _read_noise(data: NoiseMoments, codes: _Codes, pairs: Means, K_DN_per_e: float) -> tuple[Quantity, bool]:
    """The read noise's variance, and ``DarkTerms.foreign``."""
    fit, rules = codes.fit, data.rules
    rate, read, variance = float(fit.values[1]), float(fit.values[2]), float(fit.cov[2, 2])
    drifts = (pairs.rate_DN_per_s if pairs.skewed else rate) * pairs.times_s
    expected = [read + data.rounding_DN2 + K_DN_per_e * max(drift, 0.0) for drift in drifts]
    if not codes.white:
        expected = _coded_variances(data.darks, fit, K_DN_per_e, codes.row_DN)
    more = unexplained_variance(data, expected, rules.most_hits, pairs.skewed)
    if abs(more.value) > rules.foreign_sigma * more.variance**0.5:
        # Where rounding hides the distribution, half of what was not expected may be an effect of it, and what the
        # codes tell of the rest depends on the distribution as well.
        depends_on = 0.0 if codes.white else 0.25 * more.value**2 + variance
        return Quantity(max(read + more.value, 0.0), more.variance + depends_on), True
    if read <= 1.001 * LOW[2]:
        return Quantity(0.0, max(variance, LOW[2] ** 2)), False
    return Quantity(read, variance), False


def _offsets(data: NoiseMoments, codes: _Codes, single: Quantity) -> Pattern:
    """DSNU of the stack's average, or of the histograms where rounding biases the average."""
    stack = data.dark_stack
    temporal = Quantity(single.value / stack.frames, single.variance / stack.frames**2)
    offsets = dsnu(stack.mean_DN, temporal, codes.row_DN**2 / stack.frames, data.rules.defect_sigma, data.q_DN)
    if codes.white:
        return offsets
    sigma = float(np.hypot(codes.fit.cov[3, 3] ** 0.5, codes.unresolved_DN2))
    spread2, pixels = float(codes.fit.values[3]), stack.mean_DN.size
    return replace(offsets, variance=spread2, sigma=sigma, samples=pixels)


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


def unexplained_variance(
    data: NoiseMoments, expected_DN2: Sequence[float], most_hits: float, of_all: bool = False
) -> Quantity:
    """Temporal variance of dark samples, without row noise, less that expected in each pair.

    It comes from the differences of the codes, and its sigma from their fourth moment. Differences taken for hits count
    where they are more than ``most_hits`` of all: radiation does not hit so often, so that they are tails of the noise,
    or pixels with random telegraph noise (EMVA 1288, clause 6.3, averages the variance over all pixels). Pixels far
    from the others count only where ``of_all`` is True: hot ones have shot noise, dead ones have none.
    """
    values, variances = _temporal(data, most_hits, of_all)
    weights = 1.0 / variances
    return Quantity(float(np.average(values - np.asarray(expected_DN2), weights=weights)), float(1.0 / weights.sum()))


def unlike_exposures(data: NoiseMoments, dark: DarkTerms) -> bool:
    """Whether temporal noise rises with the mean of dark frames, as dark current's does, but not with exposure.

    Then exposure times are those of other frames. Where black drifts, noise rises with neither.
    """
    values, variances = _temporal(data, data.rules.most_hits, dark.skewed)
    means, times = np.array([(pair.mean_DN, pair.exposure_s) for pair in data.darks]).T

    def off(signal_DN: PerPair) -> float:
        left = values - dark.K_DN_per_e * signal_DN
        return float(np.sum((left - np.average(left, weights=1.0 / variances)) ** 2 / variances))

    by_time = off(max(dark.dark_DN_per_s.value, 0.0) * times)
    # A sensor that warms by a degree or two changes its dark current by a fraction.
    most = 0.25 * off(np.zeros(len(times)))
    beyond = chi2.sf(by_time, len(times) - 1) < data.rules.contradictory
    return bool(beyond and by_time > most and off(means) < 0.1 * by_time)


def _temporal(data: NoiseMoments, most_hits: float, of_all: bool) -> tuple[PerPair, PerPair]:
    """Temporal variance of each dark pair, and its own variance."""
    tails = sum(of.outliers for of in data.dark_moments) > most_hits * sum(of.pixels for of in data.dark_moments)
    values, variances = [], []
    for pair, of in zip(data.darks, data.dark_moments, strict=True):
        value = (of.temporal_DN2 if of_all else of.near_DN2) + tails * of.outlier_variance_DN2
        fourth = (np.sum(pair.counts * pair.differences_DN**4) + tails * of.outlier_powers[1]) / of.pixels
        values.append(value)
        variances.append(max(fourth / 4 - value**2, value**2) / of.pixels)
    return np.array(values), np.maximum(variances, 1e-30)
