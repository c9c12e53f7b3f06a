"""All that dark frames show: black, dark current, read noise and its shape, row noise, DSNU; each if it is there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.noise.codes import LEAST_VARIANCE, NORMAL_SHAPE, DarkFit, Five, Surroundings, fit_dark
from udccal.fitting.noise.data import NoiseRules
from udccal.fitting.noise.moments import Moments, NoiseMoments
from udccal.fitting.noise.patterns import Pattern, Quantity, dsnu, excess_variance


@final
@dataclass(frozen=True)
class DarkTerms:
    """Dark quantities in DN.

    ``K_DN_per_e`` is the gain that was taken for known; ``levels_cov`` is the covariance of (black, dark current);
    ``read_DN2`` is the variance of single samples without row noise; ``white``: rounding shows in no pixel's mean.
    """

    K_DN_per_e: float
    black_DN: float
    dark_DN_per_s: Quantity
    levels_cov: Float[np.ndarray, "2 2"]
    read_DN2: Quantity
    shape: Quantity
    row_DN2: Quantity
    dsnu_DN2: Quantity
    white: bool
    fit: DarkFit
    offsets: Pattern


def fit_dark_terms(data: NoiseMoments, K_DN_per_e: float, rules: NoiseRules, start: Five | None = None) -> DarkTerms:
    """Fit everything dark; ``K_DN_per_e`` is used for the shot noise of the dark current alone."""
    row, in_pairs = _row_noise(data, np.ones(len(data.darks)))
    known = Surroundings(K_DN_per_e, in_pairs, rules.background)
    fit = fit_dark(data.darks, known, rules, start)
    if not _follows(fit, rules):
        row, in_pairs = _row_noise(data, fit.edge_gains)
        known = replace(known, sigma_row_DN=in_pairs)
        fit = fit_dark(data.darks, known, rules, fit.values)
    # Temporal noise too small beside a code is not told from the pattern of rounding.
    resolved = float(fit.values[2]) + in_pairs**2 >= (rules.resolved * data.q_DN) ** 2
    row = row if resolved else _row_noise(data, np.zeros(len(data.darks)))[0]
    value, variance = float(fit.values[4]), float(fit.cov[4, 4])
    name, gain = f"read noise of another shape than normal ({NORMAL_SHAPE:.2f})", (value - NORMAL_SHAPE) ** 2 / variance
    shape = Quantity.asked(name, value, variance, data.dark_samples, gain, without=NORMAL_SHAPE)
    fit = fit if shape.there else fit_dark(data.darks, known, rules, fit.values, normal=True)
    read, read_variance, spread2 = float(fit.values[2]), float(fit.cov[2, 2]), float(fit.values[3])
    # DSNU is that of the stack's average, unless rounding bends it: then that of the histograms.
    stack, rounding = data.dark_stack, data.q_DN**2 / 12.0
    single = read + K_DN_per_e * max(float(fit.values[1]), 0.0) * stack.exposure_s + rounding
    offsets = dsnu(stack.mean_DN, single / stack.frames, in_pairs**2 / stack.frames, rules)
    # Offsets that differ smear the rounding of the mean over all pixels; that of one pixel, its own noise alone.
    white = _follows(fit, rules) and 4 * np.pi**2 * read >= rules.smeared * data.q_DN**2
    if not white:
        pixels, sigma = stack.mean_DN.size, float(np.hypot(fit.cov[3, 3] ** 0.5, 0.0 if resolved else rounding))
        offsets = replace(offsets, variance=spread2, sigma=sigma, samples=pixels, mean_variance=spread2 / pixels)
    black, levels_cov, current = _levels(data, fit, in_pairs**2, single, _follows(fit, rules), offsets)
    if read <= 1.001 * LEAST_VARIANCE:
        read, read_variance = 0.0, max(read_variance, LEAST_VARIANCE**2)
    return DarkTerms(
        K_DN_per_e=K_DN_per_e,
        black_DN=black,
        dark_DN_per_s=current,
        levels_cov=levels_cov,
        read_DN2=Quantity(read, read_variance),
        shape=shape,
        row_DN2=row,
        dsnu_DN2=Quantity.asked("DSNU", offsets.variance, offsets.sigma**2, offsets.samples),
        white=white,
        fit=fit,
        offsets=offsets,
    )


def _follows(fit: DarkFit, rules: NoiseRules) -> bool:
    """Mean codes follow the mean signal: nothing is cut off."""
    return bool(np.abs(fit.edge_gains - 1).max() < rules.white)


def _row_noise(data: NoiseMoments, edge_gains: Float[np.ndarray, " pairs"]) -> tuple[Quantity, float]:
    """Variance by rows, and its root as it happened to be in the pairs alone: that is what widened their histograms.

    Rounding and cut-off codes pass only the square of ``edge_gains`` of it, pair by pair.
    """
    nearest = int(np.argmin([abs(pair.exposure_s - data.dark_stack.exposure_s) for pair in data.darks]))
    pairs = list(zip(data.dark_moments, edge_gains, strict=True))
    stack = [] if data.dark_seen is None else [(data.dark_seen, edge_gains[nearest])]

    def asked(seen: list[tuple[Moments, float]]) -> Quantity:
        # Of row noise that follows black to less than a fifth nothing can be said.
        rows = [
            (of.rows_DN2 / gain**2, of.sampling_DN2 / gain**2, (of.frames - 1) * max(of.height - 1, 1))
            for of, gain in seen
            if gain >= 0.2 and of.rows_DN2 > 0
        ]
        # Where rounding hides all of it, it may be as large as rounding itself.
        found = excess_variance(*np.array(rows).T) if rows else (0.0, (data.q_DN**2 / 12.0) ** 2, 0.0)
        return Quantity.asked("row noise", found[0], found[1], data.dark_samples, found[2])

    row = asked(pairs + stack)
    return row, float(np.sqrt(asked(pairs).value)) if row.there else 0.0


def _levels(
    data: NoiseMoments, fit: DarkFit, row_DN2: float, single_DN2: float, follows: bool, offsets: Pattern
) -> tuple[float, Float[np.ndarray, "2 2"], Quantity]:
    """Black and dark current from the mean of every dark exposure, with its own weight."""
    means, variances, times = fit.means_DN, fit.variances_DN2, np.array([pair.exposure_s for pair in data.darks])
    stack, rounding = data.dark_stack, data.q_DN**2 / 12.0
    if follows:
        means, times = np.append(means, offsets.mean), np.append(times, stack.exposure_s)
        rows = row_DN2 / len(stack.mean_DN)
        variances = np.append(variances, (single_DN2 / stack.mean_DN.size + rows) / stack.frames)
    design = np.column_stack([np.ones_like(times), times])
    cov = scaled_inverse(design.T @ (design / variances[:, None]))
    line = cov @ (design.T @ (means / variances))
    current = Quantity.asked("dark current", float(line[1]), float(cov[1, 1]), data.dark_samples)
    # The offsets of this sensor's pixels are one draw: their mean is not that of all sensors alike.
    cov[0, 0] += offsets.mean_variance
    if not follows:
        # Black, spread and noise of coarse or cut-off codes err together, and alike in every pair.
        cov[0, 0] = max(float(cov[0, 0]), len(data.darks) * float(fit.cov[0, 0]))
    if (variances >= rounding).any():
        # What rounding hides is hidden alike in every exposure.
        cov[0, 0] += rounding
    # Black stays that of the line: a dark current too weak to be chosen must not pull it.
    return float(line[0]), cov, current
