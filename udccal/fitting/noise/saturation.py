"""Saturation: the level at which the signal stops, by flats that are full, and its sigma."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri

from udccal.fitting.noise.codes import standard_cdf
from udccal.fitting.noise.flats import Bins, Curve
from udccal.fitting.noise.frame_moments import Moments, stacked
from udccal.fitting.noise.moments import NoiseMoments
from udccal.fitting.noise.patterns import DarkTerms

# Part of full samples with the last code above which that part, and not the mean, gives the level.
_MANY_AT_THE_END = 0.02


def find_saturation(data: NoiseMoments, dark: DarkTerms, curve: Curve) -> tuple[float, float]:
    """Level in DN at which the signal stops, with its sigma.

    It is the mean of the bins in which every pixel is full, or the last code where codes end before the full well. In
    between, it follows from the fraction of samples at the end. Where no bin is full, full pixels may pile up.
    """
    full, flats, q = curve.full, data.flats, data.q_DN
    if not full.any():
        # The level lies between the brightest code seen and the largest possible one.
        unseen = max(data.top_DN - max(flat.peak_DN for flat in flats), 0.0)
        return curve.pile or (data.top_DN, unseen / math.sqrt(3.0))
    peaks = np.array([flat.peak_DN for flat in flats])
    peak = int(peaks[full.any(axis=1)].max())
    at_peak, samples = stacked(flats, "at_peak") * (peaks == peak)[:, None], stacked(flats, "samples")
    V0, row = max(float(curve.values[1]), 0.0), dark.row_DN2.value
    spread = float(np.sqrt(spread2 := V0 + dark.dsnu_DN2.value + row))
    # Bins in which most samples have the last code; of a whole frame, colours that are not full hide them.
    if (most := float(at_peak[full].max())) >= 0.5 and peak < data.top_DN:
        return float(peak), q / math.sqrt(12.0)  # known to within rounding
    if most >= 0.5:
        # So many samples come to the converter's end from a level within half a code of it, where noise is small.
        below = 0.5 * q - spread * float(ndtri(min(most, 1 - 1e-4)))
        return float(peak), max(below, 0.0) / math.sqrt(3.0)
    # Bins whose pixels are all full have no other noise, and no outliers: these would be pixels that are not full.
    temporal = V0 + data.rounding_DN2
    excess = stacked(flats, "variance_DN2") - temporal
    sure = full & (excess < 3.0 * temporal * np.sqrt(2 / stacked(flats, "dof")))
    clean = sure & np.array([[of.frames * of.outliers <= 1e-5 * of.samples.sum()] for of in flats])
    chosen = next(bins for bins in (clean, sure, full) if bins.any())
    weights, count = samples[chosen], float(samples[chosen].sum())
    part = float(np.average(at_peak[chosen], weights=weights)) if peak >= data.top_DN else 0.0
    # Each frame has its own row noise, which the bins of a row share.
    seen = [of.frames * of.height * bins.mean() for of, bins in zip(flats, chosen, strict=True)]
    z, rows = float(ndtri(part)) if part > 0 else 0.0, row / float(sum(seen))
    density = math.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
    if part > _MANY_AT_THE_END:
        own = spread2 * part * (1 - part) / density**2 / count
        # The fraction gives the level by the shape of the noise, of which the read noise's is not quite normal.
        quantile, probability = standard_cdf(dark.shape.value)
        own += V0 * (0.2 if dark.foreign else float(np.interp(part, probability, quantile)) - z) ** 2
        return peak - 0.5 * q + spread * z, math.sqrt(own + rows)
    # Few samples beyond the end lower the mean by this, if their noise is normal.
    lost = spread * (density + z * part) if part > 0 else 0.0
    # Where some pixels are not full, the possible shift of the mean adds to it.
    low = 0.0 if sure.any() else 0.5 * max(float(excess[chosen].mean()), 0.0)
    level = float(np.average(stacked(flats, "mean_DN")[chosen], weights=weights)) + lost
    rounding, short = _rounding_left(dark, V0, spread2, q), _lowered(flats, chosen, level, spread2, data)
    return level, math.sqrt(temporal / count + rounding + low + rows + lost**2 + short**2 + dark.unsteady_DN**2)


def _rounding_left(dark: DarkTerms, V0: float, spread2: float, q: int) -> float:
    """Variance that rounding leaves in the mean of full pixels, with temporal noise V0 and ``spread2`` of all pixels.

    Rounding adds sum over k of (-1)^k q sin(2 pi k x / q) f(2 pi k / q) / (pi k) to the mean of noise that has the
    characteristic function f (Widrow and Kollar, Quantization Noise, chapter 5). Tails leave more of it than normal
    noise does; as much as Laplace's where the fitted shape may have them.
    """
    frequency = 2 * np.pi * np.arange(1, 8) / q
    if dark.foreign or dark.shape.value < dark.shape.variance**0.5:
        read = 1 / (1 + 0.5 * frequency**2 * V0)
    else:
        quantile, probability = standard_cdf(dark.shape.value)
        read = np.trapezoid(np.cos(np.outer(frequency * np.sqrt(V0), quantile)), probability, axis=1)
    left = read * np.exp(-0.5 * frequency**2 * (spread2 - V0))
    return float(np.sum(2 * (left / frequency) ** 2))


def _lowered(flats: tuple[Moments, ...], chosen: Bins, level_DN: float, spread2: float, data: NoiseMoments) -> float:
    """By how much dead pixels, and those of a bin's dim end that are not full, may lower the mean of the chosen bins.

    They do by no more than they do that of the whole frame, and than they widen the bin if each is five sigma short or
    more.
    """
    short, reach = 0.0, 5 * math.hypot(math.sqrt(spread2), data.q_DN)
    wider = np.maximum(stacked(flats, "spread_DN") ** 2 - spread2 - data.rounding_DN2, 0.0) / reach
    for of, bins, wide in zip(flats, chosen, wider, strict=True):
        if bins.any():
            lack = np.maximum(level_DN - np.arange(len(of.codes)), 0.0)
            frame = float(of.codes @ (lack * (lack > reach))) / float(of.codes.sum())
            short = max(short, frame if bins.all() else min(frame, float(wide[bins].max())))
    return short
