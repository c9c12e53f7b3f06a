"""Flats: which of their bins are full or inside the sensor's range, the photon transfer curve, and saturation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from udccal.fitting.engine.orders import Choice
from udccal.fitting.engine.robust import OutlierRule, robust_sigma
from udccal.fitting.noise.codes import excess_kurtosis, standard_cdf
from udccal.fitting.noise.frame_moments import Moments, Shared, stacked
from udccal.fitting.noise.moments import NoiseMoments, steadied
from udccal.fitting.noise.patterns import DarkTerms
from udccal.fitting.noise.transfer import DarkVariance, Five, Levels, TransferFit, robust_transfer

Bins = Bool[np.ndarray, "flats bins"]
# Part of full samples with the last code above which that part, and not the mean, gives the level.
_MANY_AT_THE_END = 0.02


@final
@dataclass(frozen=True)
class Curve:
    """The photon transfer curve: the fits of all orders, None where no exposure is inside the range.

    ``full`` are bins at saturation, whose rough level is ``ceiling_DN``; without any, the ``pile`` of full pixels has
    a level and its sigma. The fit reaches ``fit_up_to`` of the rough level. The two frames of ``flickering`` flats
    differ in brightness. ``levels`` are those ``inside`` the range, less outliers.
    """

    full: Bins
    pile: tuple[float, float] | None
    ceiling_DN: float
    fit_up_to: float
    flickering: tuple[int, ...]
    inside: Levels
    levels: Levels
    choice: Choice[TransferFit] | None
    apart: Five = field(default_factory=lambda: np.zeros(5))

    @property
    def fit(self) -> TransferFit:
        """The fit of the best order."""
        assert self.choice is not None, "asked for where there are usable levels"
        return self.choice.best.fit

    @property
    def values(self) -> Five:
        """The fit's values; zeros where there is none."""
        return np.zeros(5) if self.choice is None else self.fit.values

    @property
    def cov(self) -> Float[np.ndarray, "5 5"]:
        """Covariance of the values, with what the variances' misfit and the choice of an order add."""
        assert self.choice is not None, "asked for where there are usable levels"
        orders = self.choice.spread(self.fit.samples, lambda of: of.values)
        return np.asarray(self.fit.cov * self.fit.misfit.inflation + orders + np.outer(self.apart, self.apart))

    @property
    def usable_levels(self) -> int:
        """Exposures inside the range of the fit, the stack not counted."""
        return int(self.inside.usable[: len(self.full)].any(axis=1).sum())


def fit_curve(data: NoiseMoments, dark: DarkTerms) -> Curve:
    """The curve up to 90 % of saturation, or up to 70 % where the model describes that far better."""
    full, flickering, rules = full_bins(data, dark), _flickering(data, dark), data.rules
    pile = None if full.any() else piled_up(data, dark)
    # Upper median of the saturated bins, or the converter's largest code where nothing is full.
    ceiling = pile[0] if pile else data.top_DN
    if full.any():
        ceiling = float(np.quantile(stacked(data.flats, "mean_DN")[full], 0.75))

    def up_to(part: float) -> Curve:
        inside = _inside(data, dark, part * (ceiling - dark.black_DN), ceiling)
        inside.usable[list(flickering)] = False
        empty = Curve(full, pile, ceiling, part, flickering, inside, inside, None)
        if not empty.usable_levels:
            return empty
        choice, levels = robust_transfer(inside, _dark_variance(data, dark), max(ceiling - dark.black_DN, 1.0), rules)
        return replace(empty, levels=levels, choice=choice)

    found = up_to(rules.fit_up_to)
    if not (found.choice and found.fit.misfit.found):
        return found
    for part in (rules.narrow_up_to, 0.5 * rules.fit_up_to):
        narrow = up_to(part)
        if narrow.usable_levels < rules.levels:
            break
        far_better = found.fit.misfit.ratio > 2 and narrow.fit.misfit.ratio < 0.5 * found.fit.misfit.ratio
        found = narrow if far_better else replace(found, apart=narrow.values - found.values)
    return found


def shared_by_neighbours(data: NoiseMoments, curve: Curve) -> Shared:
    """The noise of light that neighbours share, by flats inside the range with more noise than the read noise."""
    dark = min(of.temporal_DN2 for of in data.dark_moments)
    inside = zip(data.flats, curve.inside.usable, strict=False)
    seen = [of.shared for of, usable in inside if usable.any() and of.temporal_DN2 > 4 * dark]
    if not seen:
        return Shared()
    weight = np.array([of.sigma**-2 for of in seen])
    row, column = np.average([(of.along_row, of.along_column) for of in seen], axis=0, weights=weight)
    return Shared(float(row), float(column), float(weight.sum() ** -0.5))


def full_bins(data: NoiseMoments, dark: DarkTerms) -> Bins:
    """The saturated bins: as bright as any, with far less variance than the rest predicts for their mean.

    Where all flats are saturated there is no rest: bins with no more variance than the dark frames are then saturated.
    """
    mean, variance = stacked(data.flats, "mean_DN") - dark.black_DN, stacked(data.flats, "variance_DN2")
    bright: Bins = mean > 0.05 * (data.top_DN - dark.black_DN)
    if not bright.any():
        return bright
    # Saturation is a ceiling: a quiet bin well below the brightest one is something else.
    highest = bright & (mean >= 0.9 * mean.max())
    # Below saturation variance over mean is K plus a small positive part; clipping only lowers it.
    slope = variance / np.maximum(mean, 1e-9)
    collapsed: Bins = highest & (slope < 0.3 * float(np.quantile(slope[bright], 0.75)))
    quiet: Bins = highest & (variance <= 1.3 * (dark.read_DN2.value + data.rounding_DN2 + dark.row_DN2.value))
    return quiet if not collapsed.any() and quiet[bright].mean() > 0.5 else collapsed


def piled_up(data: NoiseMoments, dark: DarkTerms) -> tuple[float, float] | None:
    """Level and sigma in DN where full pixels of uneven flats pile up, or None.

    Flats that are dimmer towards the corners clip in their middle alone: no bin is full. The full pixels have the dark
    noise about one level, nothing is brighter, and shot noise has spread all others over far more codes.
    """
    q, spread2 = data.q_DN, dark.read_DN2.value + dark.dsnu_DN2.value + dark.row_DN2.value + data.rounding_DN2
    half, count, floor, middle = max(int(np.ceil(2.5 * np.sqrt(spread2) / q)), 1), 0, 0, 0.0
    width = 2 * half + 1
    for flat in data.flats:
        codes = flat.codes[::q]
        # At code c the pile has codes c - half to c + half; the floor is as many codes below them.
        up_to = np.cumsum(np.pad(codes, (2 * width, half)))
        total, end, sums = int(codes.sum()), len(codes), up_to[width:] - up_to[:-width]
        inside, below, above = sums[width + half :], sums[half : half + end], total - up_to[2 * width + half :]
        piles = (inside >= max(100, 1e-3 * total)) & (inside >= 5 * below) & (above <= 0.02 * inside)
        at = int(np.argmax(np.where(piles, inside, 0)))
        if piles[at] and inside[at] > count:
            near = np.arange(max(at - half, 0), min(at + half + 1, end))
            count, floor, middle = int(inside[at]), int(below[at]), float(np.average(near, weights=codes[near]))
    level, spread = middle * q, float(np.sqrt(spread2))
    shot2 = dark.K_DN_per_e * (level - dark.black_DN)
    if not count or shot2 < 9.0 * spread2 or level + 3.0 * spread >= data.top_DN:
        return None
    # The light of unclipped pixels shifts the mean by at most the part that they have, to the pile's end.
    return level, float(np.hypot(spread / np.sqrt(count), floor / count * half * q))


def _inside(data: NoiseMoments, dark: DarkTerms, up_to_DN: float, ceiling_DN: float) -> Levels:
    """The flats as the transfer fit takes them, with the bins that lie safely inside the sensor's range."""
    flats = data.flats if data.flat_seen is None else (*data.flats, data.flat_seen)
    mean, variance, spread = (stacked(flats, name) for name in ("mean_DN", "variance_DN2", "spread_DN"))
    if dark.foreign:
        # What was taken for hits were tails of the noise.
        variance = variance + np.array([[of.outlier_variance_DN2] for of in flats])
    above, K, q = mean - dark.black_DN, dark.K_DN_per_e, data.q_DN
    variance = steadied(flats, variance, above)
    # Bins keep 5 sigma of their noise and 2.5 of their shading away from the range's ends.
    temporal, uneven = 5.0 * np.sqrt(variance), 2.5 * np.sqrt(np.maximum(spread**2 - variance, 0.0))
    usable = (above > 0) & (above <= up_to_DN) & (mean + temporal + uneven < ceiling_DN) & (mean > temporal)
    # Rounding is white over this spread of samples and this noise.
    usable &= (spread >= 0.7 * q) & (variance >= 0.2 * q**2)
    # The distribution of few counts has steps: rounding is white once noise smears them over a code. With a variance
    # of thirty codes they do not matter.
    smeared = 2 * above / max(K, 1e-9) * (1 - np.cos(2 * np.pi * K / q))
    smeared += 4 * np.pi**2 * (dark.read_DN2.value + dark.row_DN2.value) / q**2
    usable &= (smeared >= data.rules.smeared) | (variance >= 30 * q**2)
    # Frames that are lit have an exposure: 0 says that it is not known.
    light, exposure_s, rows = np.array(
        [(of.light or np.nan, of.exposure_s, dark.row_DN2.value / (of.frames * of.height)) for of in flats]
    ).T
    by_bin = above, variance, stacked(flats, "dof"), stacked(flats, "samples"), usable
    return Levels(*by_bin, light, dark.dark_DN_per_s.value * exposure_s, rows + dark.unsteady_DN**2)


def _dark_variance(data: NoiseMoments, dark: DarkTerms) -> DarkVariance:
    """V0 from the histograms, and from the temporal variance of the dark stack where its frames were seen."""
    rounding, K, rate, read = data.rounding_DN2, dark.K_DN_per_e, dark.dark_DN_per_s.value, dark.read_DN2
    drift = rate * np.array([pair.exposure_s for pair in data.darks])
    # Dark signal in the pairs as their read noise depends on it: long exposures are noisier and count less.
    total = read.value + dark.row_DN2.value + rounding + K * drift
    points = [(read.value, read.variance**0.5, float(np.average(drift, weights=1 / total**2)))]
    seen = data.dark_seen
    # Hits were left out of the stack: where tails of the noise were taken for hits, it shows too little.
    if seen is not None and dark.white and not dark.foreign:
        # The tails are the read noise's: rounding and counts of dark current have hardly any.
        # Hot pixels are not in the dark current, unless it is skewed.
        variance = seen.temporal_DN2 if dark.skewed else seen.near_DN2
        tails = excess_kurtosis(dark.shape.value) * min(read.value, variance) ** 2 * (1 - 1 / seen.frames)
        sigma = float(np.sqrt((2 * variance**2 + tails) / float(seen.dof.sum())))
        signal = rate * seen.exposure_s
        points.append((variance - rounding - K * signal, sigma, signal))
    values, sigmas, drifts = np.array(points).T
    # An error of black acts on the curve as an error of V0 that is K times as large.
    shifted = K * np.sqrt(float(dark.levels_cov[0, 0]))
    return DarkVariance(values, np.hypot(np.maximum(sigmas, 1e-9), shifted), rounding, K, drifts)


def _flickering(data: NoiseMoments, dark: DarkTerms) -> tuple[int, ...]:
    """Flats whose frames differ in mean by more than noise explains, and by more than the frames of other flats."""
    flats, signal = data.flats, stacked(data.flats, "mean_DN").mean(axis=1) - dark.black_DN
    lit = np.flatnonzero(signal > 0)
    if len(lit) < 4:
        return ()
    apart = np.array([np.ptp(flat.shift_DN.mean(axis=1)) for flat in flats])
    noise = [4 * of.variance_DN2.mean() / of.samples.sum() + 2 * dark.row_DN2.value / of.height for of in flats]
    relative, own = apart[lit] / signal[lit], np.sqrt(np.array(noise)[lit]) / signal[lit]
    wrong = OutlierRule("flats", data.rules.outlier_sigma).off(relative / np.hypot(robust_sigma(relative), own))
    return tuple(int(i) for i in lit[wrong])


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
    noise does; as much as Laplace's where the fitted shape has them.
    """
    frequency = 2 * np.pi * np.arange(1, 8) / q
    if dark.foreign or dark.shape.value < -(dark.shape.variance**0.5):
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
