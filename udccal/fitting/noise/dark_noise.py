"""The noise of dark frames by exposure: what the fit of codes leaves, and whether it is the mean's dark current's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.misfit import chi2_tail, chi2_test
from udccal.fitting.engine.orders import Quantity
from udccal.fitting.noise.line_noise import LineNoise
from udccal.fitting.noise.moments import NoiseMoments
from udccal.fitting.noise.patterns import Cov, DarkTerms

PerPair = Float[np.ndarray, " _"]
# Of black and dark current, or of noise without and by exposure.
Two = Float[np.ndarray, "2"]
# Of the noise's slope with exposure: so much, pixels with more dark current than others may explain.
_EXPLAINED = 0.03


def dark_line(means: PerPair, variances: PerPair, times: PerPair) -> tuple[Two, Cov, PerPair]:
    """Black and dark current in DN per s by a line through mean signals, their covariance, and what the line leaves.

    One exposure time does not tell dark current from black: all is black.
    """
    design = np.column_stack([np.ones_like(times), times * bool(np.ptp(times) > 0)])
    cov = scaled_inverse(design.T @ (design / variances[:, None]))
    values = cov @ (design.T @ (means / variances))
    return values, cov, means - design @ values


def unexplained_variance(
    data: NoiseMoments, expected_DN2: PerPair, most_hits: float, columns: LineNoise, of_all: bool = False
) -> Quantity:
    """Temporal variance of dark samples, without row noise, less that expected in each pair.

    It comes from the differences of the codes, and its sigma from their fourth moment and the draws of ``columns``.
    Where few differences have most of it, too few of them are found more often than too many, and the fourth moment is
    then small as well: the sigma is larger by three times the skewness of the mean. No pair has weight by its own
    fourth moment, for the same reason.

    Differences taken for hits count where they are more than ``most_hits`` of all: radiation does not hit so often, so
    that they are tails of the noise, or pixels with random telegraph noise (EMVA 1288, clause 6.3, averages the
    variance over all pixels). Pixels far from the others count only where ``of_all`` is True: hot ones have shot noise,
    dead ones have none.
    """
    values, variances, thirds = _temporal(data, most_hits, columns, of_all)
    weights = np.array([of.pixels for of in data.dark_moments]) / np.maximum(expected_DN2, data.rounding_DN2) ** 2
    weights /= weights.sum()
    variance = float(weights**2 @ variances)
    skewness = float(weights**3 @ thirds) / variance**1.5
    return Quantity(float(weights @ (values - expected_DN2)), variance * (1 + 3 * skewness) ** 2)


def with_own_noise(data: NoiseMoments, dark: DarkTerms, K_sigma: float) -> DarkTerms:
    """Read noise from the noise of dark frames by exposure alone, where their mean tells another dark current.

    ``K_sigma`` is that of the gain, in DN per electron.

    Cameras that compensate dark current keep the mean and not its noise; others raise black with exposure, which makes
    none (EMVA 1288, release 4.0, clause 7.1, takes dark current from the noise of cameras that compensate it).
    """
    times = np.array([pair.exposure_s for pair in data.darks])
    if not dark.white or len(np.unique(times)) < 3:
        return dark
    # What was taken for hits were tails of a noise that no distribution describes.
    most_hits = 0.0 if dark.foreign else data.rules.most_hits
    values, variances, _ = _temporal(data, most_hits, dark.columns, dark.skewed)
    (read, slope), cov, left = dark_line(values, variances, times)
    cov *= max(float(np.sum(left**2 / variances)) / (len(times) - 2), 1.0)
    expected = dark.shot_DN2(dark.K_DN_per_e, 1.0)
    by_gain2, by_mean2 = (K_sigma / dark.K_DN_per_e * expected) ** 2, dark.K_DN_per_e**2 * float(dark.levels_cov[1, 1])
    off, off_2 = slope - expected, float(cov[1, 1]) + by_gain2 + by_mean2
    if not chi2_test(off**2 / off_2, 1.0).found or abs(off) < _EXPLAINED * max(slope, expected):
        return dark
    # The codes' distribution was fitted with another shot noise, which its shape has followed.
    shape = replace(dark.shape, variance=max(dark.shape.variance, data.rules.shape_sigma**2))
    own = Quantity(max(float(slope), 0.0), float(cov[1, 1]))
    return replace(dark, read_DN2=Quantity(max(float(read) - data.rounding_DN2, 0.0), float(cov[0, 0])), shape=shape,
                   own_shot_DN2_per_s=own)  # fmt: skip


def unlike_exposures(data: NoiseMoments, dark: DarkTerms) -> bool:
    """Whether temporal noise rises with the mean of dark frames, as dark current's does, but not with exposure.

    Then exposure times are those of other frames. Where black drifts, noise rises with neither.
    """
    values, variances, _ = _temporal(data, data.rules.most_hits, dark.columns, dark.skewed)
    means, times = np.array([(pair.mean_DN, pair.exposure_s) for pair in data.darks]).T

    def off(signal_DN: PerPair) -> float:
        left = values - dark.K_DN_per_e * signal_DN
        return float(np.sum((left - np.average(left, weights=1.0 / variances)) ** 2 / variances))

    by_time = off(max(dark.dark_DN_per_s.value, 0.0) * times)
    # A sensor that warms by a degree or two changes its dark current by a fraction.
    most = 0.25 * off(np.zeros(len(times)))
    beyond = chi2_tail(by_time, len(times) - 1) < data.rules.contradictory
    return bool(beyond and by_time > most and off(means) < 0.1 * by_time)


def _temporal(
    data: NoiseMoments, most_hits: float, columns: LineNoise, of_all: bool
) -> tuple[PerPair, PerPair, PerPair]:
    """Temporal variance of each dark pair, its own variance, and its third moment."""
    tails = sum(of.outliers for of in data.dark_moments) > most_hits * sum(of.pixels for of in data.dark_moments)
    values, variances, thirds = [], [], []
    for pair, of in zip(data.darks, data.dark_moments, strict=True):
        values.append((of.temporal_DN2 if of_all else of.near_DN2) + tails * of.outlier_variance_DN2)
        fourth, sixth = (
            (np.sum(pair.counts * pair.differences_DN**power) + tails * of.outlier_powers[power // 2 - 1]) / of.pixels
            for power in (4, 6)
        )
        variances.append(max(fourth / 4 - values[-1] ** 2, values[-1] ** 2) / of.pixels + columns.drawn_DN4(1))
        thirds.append(sixth / 8 / of.pixels**2)
    return np.array(values), np.maximum(variances, 1e-30), np.array(thirds)
