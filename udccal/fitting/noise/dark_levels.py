"""Black and dark current: a line through the mean signals of dark exposures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.misfit import excess_sigma
from udccal.fitting.engine.orders import Quantity
from udccal.fitting.noise.codes import DarkFit
from udccal.fitting.noise.moments import NoiseMoments
from udccal.fitting.noise.patterns import Pattern

PerPair = Float[np.ndarray, " _"]


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
class Means:
    """Mean signals of the dark pairs; ``skewed``: those of all pixels, as no distribution has them.

    Otherwise they are those of the histograms, and ``doubt`` is how far the mean codes would move black and dark
    current.
    """

    times_s: PerPair
    means_DN: PerPair
    variances_DN2: PerPair
    doubt: PerPair
    skewed: bool = False

    @property
    def rate_DN_per_s(self) -> float:
        """Dark current."""
        return float(_Line.through(self.means_DN, self.variances_DN2, self.times_s).values[1])


def dark_means(data: NoiseMoments, fit: DarkFit, row_DN2: float | None) -> Means:
    """By the fit's distribution, unless mean codes are far off: read noise and dark current may have one tail.

    Without ``row_DN2``, rounding hides the noise from frame to frame. Mean codes then tell no tail; where offsets
    smear the rounding, they tell how far off the fit's mean is.
    """
    times = np.array([pair.exposure_s for pair in data.darks])
    fitted = times, fit.means_DN, fit.variances_DN2
    if row_DN2 is None and not fit.follows:
        return Means(*fitted, np.zeros(2))
    codes, dark = np.array([pair.mean_DN for pair in data.darks]), data.dark_moments
    by_fit = _Line.through(fit.means_DN, fit.variances_DN2, times)
    if row_DN2 is None:
        return Means(*fitted, _Line.through(codes, fit.variances_DN2, times).values - by_fit.values)
    own = np.array([of.temporal_DN2 / (2 * of.pixels) + row_DN2 / (2 * of.height) for of in dark])
    by_codes = _Line.through(codes, own, times)
    doubt = by_codes.values - by_fit.values
    if np.all(np.abs(doubt) <= data.rules.foreign_sigma * np.sqrt(np.diag(by_codes.cov))):
        return Means(*fitted, doubt)
    everywhere = np.array([np.average(of.mean_DN, weights=of.samples) for of in dark])
    own += [of.outlier_variance_DN2 / (2 * of.pixels) for of in dark]
    return Means(times, everywhere, own, np.zeros(2), True)


def _frozen(temporal_codes2: float) -> float:
    """The part of its rounding that a pixel keeps from frame to frame, with noise of this variance in codes squared."""
    return float(np.exp(-4 * np.pi**2 * temporal_codes2))


@final
@dataclass(frozen=True)
class Levels:
    """Black and dark current with their covariance, and ``DarkTerms.unsteady_DN``."""

    black_DN: float
    current: Quantity
    cov: Float[np.ndarray, "2 2"]
    unsteady_DN: float


def dark_levels(
    data: NoiseMoments,
    fit: DarkFit,
    pairs: Means,
    white: bool,
    row_DN2: float,
    single_DN2: float,
    offsets: Pattern,
    curvature: float,
) -> Levels:
    """Black and dark current from the mean of every dark exposure, with its own weight."""
    means, variances, times = pairs.means_DN, pairs.variances_DN2, pairs.times_s
    # The stack's mean is without hot pixels.
    if fit.follows and not pairs.skewed:
        stack = data.dark_stack
        means, times = np.append(means, offsets.mean), np.append(times, stack.exposure_s)
        rows = row_DN2 / len(stack.mean_DN)
        own = single_DN2 / stack.frames + data.rounding_DN2 * _frozen(single_DN2 / data.q_DN**2)
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
    # Rounding of pixels without noise is the same in every frame.
    cov[0, 0] += data.rounding_DN2 * _frozen(float(fit.values[2]) / data.q_DN**2) / data.dark_stack.mean_DN.size
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
    return Levels(float(line.values[0]), current, cov, unsteady)
