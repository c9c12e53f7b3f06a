"""Dark frames: black and read noise; dark current, row noise and DSNU, each if the data support it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from udccal.fitting.engine.misfit import excess_sigma, f_test
from udccal.fitting.engine.orders import Quantity
from udccal.fitting.noise.codes import LOW, DarkFit, Five, excess_kurtosis, fit_dark, pair_probability, row_gain
from udccal.fitting.noise.dark_noise import PerPair, Two, dark_line, unexplained_variance
from udccal.fitting.noise.line_noise import LineNoise, column_noise, row_noise
from udccal.fitting.noise.moments import NoiseMoments
from udccal.fitting.noise.patterns import Cov, DarkTerms, dsnu


def fit_dark_terms(data: NoiseMoments, K_DN_per_e: float, start: Five, curvature: float = 0.0) -> DarkTerms:
    """Fit all dark quantities; only the dark current's shot noise depends on ``K_DN_per_e``.

    ``curvature`` is the response's in 1/DN: dark signal bends as light does.
    """
    codes, stack = _with_means(data, _fit_codes(data, K_DN_per_e, start)), data.dark_stack
    fit, columns = codes.fit, codes.columns
    read, foreign = _read_noise(data, codes, K_DN_per_e)
    # Of one frame of the stack.
    shot = K_DN_per_e * max(float(fit.values[1]), 0.0) * stack.exposure_s
    single = Quantity(read.value + shot + data.rounding_DN2, read.variance)
    if seen := data.dark_seen:
        # Its own frames say what noise the average has, whatever the distribution.
        single = Quantity(seen.near_DN2, 2 * seen.near_DN2**2 / float(seen.dof.sum()))
        single = replace(single, variance=single.variance + columns.drawn_DN4(seen.frames - 1))
    temporal = Quantity(single.value / stack.frames, single.variance / stack.frames**2)
    rules = data.rules
    offsets = dsnu(stack.mean_DN, temporal, codes.rows, columns, stack.frames, rules.defect_sigma, data.q_DN, foreign)
    if not codes.white:
        # Rounding biases the average: the histograms tell the offsets.
        sigma, pixels = float(np.hypot(fit.cov[3, 3] ** 0.5, codes.unresolved_DN2)), stack.mean_DN.size
        offsets = replace(offsets, variance=float(fit.values[3]), sigma=sigma, samples=pixels)
    # The stack's mean is without hot pixels.
    more = (offsets.mean, single.value) if fit.follows and not codes.skewed else None
    levels = _levels(data, codes, more, curvature)
    spread = Quantity.asked("DSNU", offsets.variance, offsets.sigma**2, offsets.samples)
    shape = Quantity(float(fit.values[4]), float(fit.cov[4, 4]))
    flags = codes.white, foreign, codes.skewed
    return DarkTerms(K_DN_per_e, curvature, *levels, read, shape, codes.rows, columns, spread, *flags, fit, offsets)


@final
@dataclass(frozen=True)
class _Codes:
    """The fit of the dark codes, and the noise of rows that agrees with it: ``row_DN`` is that of the pairs alone.

    ``unresolved_DN2`` is the row noise that rounding may hide; ``white`` and ``skewed`` as in ``DarkTerms``. Mean codes
    would change black and dark current by ``doubt``.
    """

    fit: DarkFit
    rows: LineNoise
    row_DN: float
    columns: LineNoise
    unresolved_DN2: float
    white: bool
    doubt: Two
    skewed: bool = False


def _fit_codes(data: NoiseMoments, K_DN_per_e: float, start: Five) -> _Codes:
    """Fit the codes and the row noise by turns: each needs the other."""
    rules, unresolved = data.rules, 0.0

    def fitted(row_DN: float, start: Five, normal: bool = False) -> DarkFit:
        return fit_dark(data.darks, K_DN_per_e, row_DN, rules, start, normal)

    rows, row_DN = row_noise(data, np.ones(len(data.darks)))
    fit = fitted(row_DN, start)
    for _ in range(10):
        gains = np.array([row_gain(pair, fit.values, K_DN_per_e, row_DN) for pair in data.darks])
        before, (rows, row_DN) = row_DN, row_noise(data, gains)
        if abs(row_DN**2 - before**2) <= 0.1 * rows.DN2.variance**0.5:
            break
        # Each depends on the other in the opposite sense: half-way between is near to where both agree.
        row_DN = float(np.sqrt(0.5 * (row_DN**2 + before**2)))
        fit = fitted(row_DN, fit.values)
    if float(fit.values[2]) + row_DN**2 < (0.15 * data.q_DN) ** 2:
        # Temporal noise below 0.15 of a code cannot be distinguished from the pattern of rounding.
        rows, unresolved = row_noise(data, np.zeros(len(data.darks)))[0], data.rounding_DN2
    columns = column_noise(data)
    fit = _with_drawn_lines(fit, data, row_DN, rows, columns)
    if row_DN > 0 and np.abs(gains - 1).max() > rules.white:
        # Rounding hides part of the row noise, and what is wrong with it is taken for read noise.
        fit = fit.doubted(fitted(float(np.sqrt(max(row_DN**2 - rows.DN2.variance**0.5, 0.0))), fit.values).values)
    # Different offsets smear the rounding in the mean over all pixels; only a pixel's own noise smears its rounding.
    white = fit.follows and 4 * np.pi**2 * float(fit.values[2]) >= rules.smeared * data.q_DN**2
    if not white:
        # Coarse codes hardly show the distribution, and all that they tell depends on it: of noise below a fifth of a
        # code, its shape as well.
        normal = fitted(row_DN, fit.values, True).values
        shown = float(fit.values[2]) >= (0.2 * data.q_DN) ** 2
        fit = fit.doubted(np.append(normal[:4], fit.values[4] if shown else normal[4]))
        fit.cov[2, 2] += (0.5 * fit.values[2]) ** 2
    return _Codes(fit, rows, row_DN, columns, unresolved, white, np.zeros(2))


def _with_drawn_lines(fit: DarkFit, data: NoiseMoments, row_DN: float, rows: LineNoise, columns: LineNoise) -> DarkFit:
    """The fit with the error that a finite number of rows and columns adds to its covariance.

    All samples of a row share one draw of its noise, and the draws of a few hundred rows have tails of their own. The
    fit, which takes them for normal, gives these to the read noise. Rows of two frames that agree by chance look like
    offsets of pixels; where there are none, rows that disagree look like less read noise. The noise of columns is a
    part of the read noise, with the error of its draws.
    """
    (_, _, read, spread2, shape), cov, pairs = fit.values.tolist(), fit.cov.copy(), len(data.darks)
    drawn, by_column = row_DN**4 / (pairs * rows.independent), columns.drawn_DN4(pairs)
    cov[[2, 3], [2, 3]] += np.array([spread2 <= 1.001 * LOW[3], True]) * drawn + [by_column, 0.5 * by_column]
    if cov[4, 4] > 0:
        slope = (excess_kurtosis(shape + 0.01) - excess_kurtosis(shape - 0.01)) / 0.02
        # The fourth cumulant of n normal draws has the variance 24 sigma^8 / n, and a pair has two of each row.
        fourth = float(np.sqrt(12 * drawn * row_DN**4 + 6 * by_column * columns.DN2.value**2))
        error = min(fourth / (abs(slope) * read**2), data.rules.shape_sigma)
        along = fit.cov[:, 4] / fit.cov[4, 4] * error
        cov += np.outer(along, along)
    return replace(fit, cov=cov)


def _with_means(data: NoiseMoments, found: _Codes) -> _Codes:
    """The fit with the mean signals of the pairs, and what mean codes say of them.

    Means are those of the fit's distribution, unless mean codes are far off: read noise and dark current may have one
    tail. Then they are those of all pixels. Where rounding is not white, it hides the noise from frame to frame. Mean
    codes then tell no tail; where offsets smear the rounding, they tell how far off the fit's mean is.
    """
    fit, dark = found.fit, data.dark_moments
    if not fit.follows:
        return found
    times, codes = np.array([(pair.exposure_s, pair.mean_DN) for pair in data.darks]).T
    own = np.array([of.temporal_DN2 / (2 * of.pixels) + found.row_DN**2 / (2 * of.height) for of in dark])
    # Of equal weights: where the means do not lie on a line, others would make another one.
    weighed = own if found.white else fit.variances_DN2
    by_codes, cov, _ = dark_line(codes, weighed, times)
    doubt = by_codes - dark_line(fit.means_DN, weighed, times)[0]
    if not found.white or np.all(np.abs(doubt) <= data.rules.foreign_sigma * np.sqrt(np.diag(cov))):
        return replace(found, doubt=doubt)
    own += [of.outlier_variance_DN2 / (2 * of.pixels) for of in dark]
    fit = replace(fit, means_DN=np.array([of.level_DN for of in dark]), variances_DN2=own)
    return replace(found, fit=fit, skewed=True)


def _kept_rounding(data: NoiseMoments, temporal_DN2: float) -> float:
    """Variance of the rounding that a pixel with this noise keeps from frame to frame."""
    return data.rounding_DN2 * float(np.exp(-4 * np.pi**2 * (temporal_DN2 / data.q_DN**2)))


def _levels(
    data: NoiseMoments, codes: _Codes, more: tuple[float, float] | None, curvature: float
) -> tuple[float, Quantity, Cov, float, float]:
    """Black, dark current, their covariance, and ``DarkTerms.unsteady_DN`` and ``drift_DN_per_s``, by all exposures.

    ``more`` is the stack's mean, and the temporal variance of one of its frames.
    """
    fit, stack, times = codes.fit, data.dark_stack, np.array([pair.exposure_s for pair in data.darks])
    means, variances = fit.means_DN, fit.variances_DN2
    if more:
        means, times = np.append(means, more[0]), np.append(times, stack.exposure_s)
        own = (more[1] / stack.frames + _kept_rounding(data, more[1])) / stack.mean_DN.size
        variances = np.append(variances, own + codes.row_DN**2 / len(stack.mean_DN) / stack.frames)
    means = means + curvature * np.maximum(means - float(fit.values[0]), 0.0) ** 2
    (black, rate), cov, left = dark_line(means, variances, times)
    apart, unsteady, drift = bool(np.ptp(times) > 0), 0.0, np.zeros(2)
    if codes.white:
        dof = float(len(times) - 1 - apart)
        unsteady = excess_sigma(left**2, variances, np.ones_like(means), dof)
        # A few exposures tell the scatter of black only roughly (Student's t).
        unsteady *= (dof / max(dof - 2, 1)) ** 0.5
        (black, rate), cov, _ = dark_line(means, variances + unsteady**2, times)
        # The stack was taken at another time.
        pairs = np.s_[: len(data.darks)]
        drift = _drift(means[pairs], variances[pairs] + unsteady**2, times[pairs]) if unsteady else drift
    cov = cov + np.outer(codes.doubt, codes.doubt)
    # Rounding of pixels without noise is the same in every frame.
    cov[0, 0] += _kept_rounding(data, float(fit.values[2])) / stack.mean_DN.size
    # All of black may be dark current.
    cov[1, 1] = cov[1, 1] if apart else (black / max(float(times[0]), 1e-6)) ** 2
    current = Quantity.asked("dark current", float(rate), float(cov[1, 1]), data.dark_samples)
    by_choice = current.variance - float(cov[1, 1])
    if not fit.follows:
        # With coarse or cut-off codes, the errors of black, spread and noise are common to all pairs.
        cov[[0, 1], [0, 1]] = np.maximum(np.diag(cov), np.diag(fit.cov)[:2] * [len(data.darks), 1])
    if any(own == pair.step_DN**2 / 12.0 for own, pair in zip(fit.variances_DN2, data.darks, strict=True)):
        # Rounding hides the same in every exposure.
        cov[0, 0] += data.rounding_DN2
    cov[1, 1] += by_choice
    # A dark current that drifts is there, though no number is its own.
    cov += np.outer(drift, drift)
    # Black stays that of the line: a dark current too weak to be chosen must not shift it.
    return float(black), current, cov, unsteady, float(abs(drift[1]))


def _drift(means: PerPair, variances: PerPair, times: PerPair) -> Two:
    """How far black and dark current of a curve at the shortest exposure are from the line's; 0 if it bends by chance.

    Exposures that are taken in order are bent by whatever drifts meanwhile.
    """
    line, _, left = dark_line(means, variances, times)
    design = np.column_stack([np.ones_like(times), times, (times - times.min()) ** 2])
    bent = np.linalg.lstsq(design / np.sqrt(variances)[:, None], means / np.sqrt(variances))[0]
    off, rest = (float(np.sum(one**2 / variances)) for one in (left, means - design @ bent))
    dof = len(times) - 2
    return bent[:2] - line if f_test((off - rest) / off * dof, 1, float(dof)).found else np.zeros(2)


def _read_noise(data: NoiseMoments, codes: _Codes, K_DN_per_e: float) -> tuple[Quantity, bool]:
    """The read noise's variance, and ``DarkTerms.foreign``."""
    fit, values, times = codes.fit, codes.fit.values, np.array([pair.exposure_s for pair in data.darks])
    read, variance = float(values[2]), float(fit.cov[2, 2])
    rate = dark_line(fit.means_DN, fit.variances_DN2, times)[0][1] if codes.skewed else values[1]
    expected = read + data.rounding_DN2 + K_DN_per_e * np.maximum(rate * times, 0.0)
    if not codes.white:
        # That of the fitted distribution in each pair's codes, without row noise.
        for i, pair in enumerate(data.darks):
            p = pair_probability(pair, values, K_DN_per_e, codes.row_DN, 0.0)
            by_row = row_gain(pair, values, K_DN_per_e, codes.row_DN) * codes.row_DN
            if (inside := float(p.sum())) > 0:  # It is 0 where pixels that fill keep a mean off the line.
                expected[i] = float(np.sum(p * pair.differences_DN**2)) / (2 * inside) - by_row**2
    # Tails that are heavier than the family's heaviest.
    heavy = codes.white and values[4] <= LOW[4] + 1e-3
    most_hits = 0.0 if heavy else data.rules.most_hits
    more = unexplained_variance(data, expected, most_hits, codes.columns, codes.skewed)
    if heavy or abs(more.value) > data.rules.foreign_sigma * more.variance**0.5:
        # Where rounding hides the distribution, half of what was not expected may be an effect of it, and what the
        # codes tell of the rest depends on the distribution as well.
        depends_on = 0.0 if codes.white else 0.25 * more.value**2 + variance
        lost = _cut_off(data)
        return Quantity(max(read + more.value + lost, 0.0), more.variance + depends_on + lost**2), True
    if read <= 1.001 * LOW[2]:
        return Quantity(0.0, max(variance, LOW[2] ** 2)), False
    return Quantity(read, variance), False


def _cut_off(data: NoiseMoments) -> float:
    """Variance that code 0 takes off dark samples, which is as uncertain as it is large.

    Beyond x, tails that fall as 1 / |x|^5 have the mean square 2 x^2, of which code 0 leaves x^2.
    """
    of_zero = [float(of.codes[0]) * of.level_DN**2 / float(of.codes.sum()) for of in data.dark_moments]
    return float(np.mean(of_zero))
