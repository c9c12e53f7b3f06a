"""Where the signal stops: from flats whose temporal variance has collapsed, as censored samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from scipy.special import ndtri

from udccal.fitting.noise.moments import PairMoments

# A bin whose variance has fallen below this fraction of the straight line is saturated.
_COLLAPSED = 0.3
# No brighter in variance than this times the dark frames: no light gets through, whatever the line says.
_QUIET = 1.3
# A full bin shows no noise but that which comes after the clipping, within so many sigma of its variance.
_WITHIN = 3.0
# More stray samples than this among the clipped ones: some pixels are not full yet.
_STRAY = 1e-5
# Of all samples at one code: above the first share the codes end below the full well, below the second far above it.
_AT_END, _FAR = 0.5, 1e-3
# A level known to whole codes only.
_ROUNDING_SIGMA = float(1 / np.sqrt(12.0))

Bins = Bool[np.ndarray, "levels bins"]


@dataclass(frozen=True)
class Saturation:
    """Level in DN with its sigma (patterns of the offsets not counted), and the number of flat bins that reached it."""

    level_DN: float
    sigma_DN: float
    bins: int


@dataclass(frozen=True)
class Plateau:
    """Noise of a full sample in DN^2: temporal variance (rounding in it), pixels' offsets, rows; and the code step."""

    temporal_DN2: float
    offsets_DN2: float
    row_DN2: float
    q_DN: int


def clipped(flats: tuple[PairMoments, ...], black_DN: float, dark_DN2: float, top_code_DN: float) -> Bins:
    """Bins that are saturated: variance under 30 % of what the rest predicts for their mean, and as bright as any.

    Where all flats are saturated there is no rest: then those are that show no more variance than the dark frames.
    """
    mean = np.stack([flat.mean_DN for flat in flats]) - black_DN
    variance = np.stack([flat.variance_DN2 for flat in flats])
    bright = mean > 0.05 * (top_code_DN - black_DN)
    if not bright.any():
        return np.zeros(mean.shape, bool)
    slope = variance / np.maximum(mean, 1e-9)
    # Below saturation variance over mean is K plus a small positive part; clipping only lowers it.
    usual = float(np.quantile(slope[bright], 0.75))
    # Saturation is a ceiling: a quiet bin well below the brightest one is something else.
    highest = mean >= 0.9 * mean.max()
    collapsed: Bins = bright & (slope < _COLLAPSED * usual) & highest
    if collapsed.any():
        return collapsed
    quiet: Bins = bright & (variance <= _QUIET * dark_DN2) & highest
    return quiet if quiet[bright].mean() > 0.5 else np.zeros(mean.shape, bool)


def rough_level(flats: tuple[PairMoments, ...], full: Bins, top_code_DN: float) -> float:
    """Upper median of the saturated bins, or the converter's largest code where there is none."""
    mean = np.stack([flat.mean_DN for flat in flats])
    return float(np.quantile(mean[full], 0.75)) if full.any() else top_code_DN


def find_saturation(flats: tuple[PairMoments, ...], full: Bins, plateau: Plateau, top_code_DN: float) -> Saturation:
    """Level at which the signal stops.

    Where the full well lies below the converter's end, the mean of the bins in which every pixel is full; where codes
    end first, that code; between, from the share of samples at the end.
    """
    levels = np.flatnonzero(full.any(axis=1))
    if not levels.size:
        # Somewhere from the brightest code seen to the largest there is.
        seen = max(flat.peak_DN for flat in flats)
        return Saturation(top_code_DN, max(top_code_DN - seen, 0.0) / float(np.sqrt(3.0)), 0)
    count = int(full.sum())
    peak = max(flats[i].peak_DN for i in levels)
    if max(flats[i].at_peak for i in levels) >= _AT_END:
        # Of codes at the converter's end nothing is uncertain; a level between them is known to rounding.
        return Saturation(float(peak), _ROUNDING_SIGMA if peak < top_code_DN else 0.0, count)
    found = [_level(flats[i], full[i], plateau, peak, top_code_DN) for i in levels]
    clean = [one for one, i in zip(found, levels, strict=True) if _strays(flats[i]) <= _STRAY and one[2]]
    values, variances, _ = np.array(clean or found, dtype=np.float64).T
    weight = 1 / np.maximum(variances, 1e-12)
    return Saturation(float(np.average(values, weights=weight)), float(1 / np.sqrt(weight.sum())), count)


def _strays(flat: PairMoments) -> float:
    return 2 * flat.outliers / float(flat.samples.sum())


def _level(
    flat: PairMoments, full: Bool[np.ndarray, " bins"], plateau: Plateau, peak: int, top_code_DN: float
) -> tuple[float, float, bool]:
    """Saturation by one level, the variance of it, and whether its pixels are all full."""
    excess = flat.variance_DN2 - plateau.temporal_DN2
    sure = full & (excess < _WITHIN * plateau.temporal_DN2 * np.sqrt(2 / flat.dof))
    chosen = sure if sure.any() else full
    samples = float(flat.samples[chosen].sum())
    rows = plateau.row_DN2 / (flat.frames * flat.height) * (full.size / float(chosen.sum()))
    spread = float(np.sqrt(plateau.temporal_DN2 - plateau.q_DN**2 / 12.0 + plateau.offsets_DN2 + plateau.row_DN2))
    if peak >= top_code_DN and flat.at_peak > _FAR:
        z = float(ndtri(flat.at_peak))
        density = float(np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi))
        own = spread**2 * flat.at_peak * (1 - flat.at_peak) / density**2 / samples
        return peak - 0.5 * plateau.q_DN + spread * z, own + rows, bool(sure.any())
    mean = float(np.average(flat.mean_DN[chosen], weights=flat.samples[chosen]))
    level, gain = _unrounded(mean, spread, plateau.q_DN)
    # Of the correction for rounding a third is taken for uncertain: it rests on the shape of the noise.
    own = plateau.temporal_DN2 / samples / gain**2 + ((level - mean) / 3) ** 2
    if not sure.any():
        # Some pixels are not full: by as much as the mean may lie low, it is uncertain.
        own += 0.5 * max(float(excess[chosen].mean()), 0.0)
    return level, own + rows, bool(sure.any())


def _unrounded(mean_DN: float, spread_DN: float, q_DN: int) -> tuple[float, float]:
    """Level whose normal noise, rounded to steps of ``q_DN``, has this mean; and the slope of the mean over the level.

    Rounding adds sum over k of (-1)^k sin(2 pi k x) exp(-2 (pi k s)^2) / (pi k) to the mean, x and s in steps
    (Widrow and Kollar, Quantization Noise, chapter 5).
    """
    k = np.arange(1, 8)
    damped = (-1.0) ** k * np.exp(-2 * (np.pi * k * spread_DN / q_DN) ** 2)
    x, slope = mean_DN / q_DN, 1.0
    for _ in range(30):
        off = x + float(np.sum(damped * np.sin(2 * np.pi * k * x) / (np.pi * k))) - mean_DN / q_DN
        slope = max(1 + float(np.sum(2 * damped * np.cos(2 * np.pi * k * x))), 0.05)
        x -= float(np.clip(off / slope, -0.1, 0.1))
    return x * q_DN, slope
