"""Flats: which of their bins lie inside the sensor's range, the photon transfer curve, and saturation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from udccal.fitting.engine.orders import Choice
from udccal.fitting.engine.robust import OutlierRule, robust_sigma
from udccal.fitting.noise.clipping import Bins, full_bins, piled_up, stacked
from udccal.fitting.noise.codes import excess_kurtosis, smeared, standard_cdf
from udccal.fitting.noise.dark import DarkTerms
from udccal.fitting.noise.moments import Moments, NoiseMoments
from udccal.fitting.noise.transfer import DarkVariance, Five, Levels, TransferFit, robust_transfer

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

    @property
    def fit(self) -> TransferFit:
        """The fit of the best order."""
        assert self.choice is not None, "asked for where there are usable levels"
        return self.choice.best.fit

    @property
    def values(self) -> Five:
        """The fit's values; zeros where there is none."""
        return np.zeros(5) if self.choice is None else self.choice.best.fit.values

    @property
    def cov(self) -> Float[np.ndarray, "5 5"]:
        """Covariance of the values, with what the variances' misfit and the choice of an order add."""
        assert self.choice is not None, "asked for where there are usable levels"
        return np.asarray(
            self.fit.cov * self.fit.misfit.inflation + self.choice.spread(self.fit.samples, lambda of: of.values)
        )

    @property
    def usable_levels(self) -> int:
        """Exposures inside the range of the fit, the stack not counted."""
        return int(self.inside.usable[: len(self.full)].any(axis=1).sum())


def fit_curve(data: NoiseMoments, dark: DarkTerms) -> Curve:
    """The curve up to 90 % of saturation, or up to 70 % where the model describes that far better."""
    full, flickering, rules = full_bins(data, dark), _flickering(data, dark), data.rules
    pile = None if full.any() else piled_up(data, dark)
    # Upper median of the saturated bins, or the converter's largest code where nothing is full.
    ceiling = data.top_DN
    if full.any():
        ceiling = float(np.quantile(stacked(data.flats, "mean_DN")[full], 0.75))
    elif pile:
        ceiling = pile[0]

    def up_to(part: float) -> Curve:
        inside = _inside(data, dark, part * (ceiling - dark.black_DN), ceiling)
        inside.usable[list(flickering)] = False
        empty = Curve(full, pile, ceiling, part, flickering, inside, inside, None)
        if not empty.usable_levels:
            return empty
        choice, levels = robust_transfer(inside, _dark_variance(data, dark), max(ceiling - dark.black_DN, 1.0), rules)
        return replace(empty, levels=levels, choice=choice)

    found = up_to(rules.fit_up_to)
    if found.choice and found.fit.misfit.ratio > 2:
        narrow = up_to(rules.narrow_up_to)
        if narrow.usable_levels >= rules.levels and narrow.fit.misfit.ratio < 0.5 * found.fit.misfit.ratio:
            return narrow
    return found


def _inside(data: NoiseMoments, dark: DarkTerms, up_to_DN: float, ceiling_DN: float) -> Levels:
    """The flats as the transfer fit takes them, with the bins that lie safely inside the sensor's range."""
    flats = data.flats if data.flat_seen is None else (*data.flats, data.flat_seen)
    mean, variance, spread = (stacked(flats, name) for name in ("mean_DN", "variance_DN2", "spread_DN"))
    if dark.foreign:
        # What was taken for hits were tails of the noise.
        pixels = [2 * (of.frames - 1) * float(of.samples.sum()) / of.frames for of in flats]
        tails = np.array([of.outlier_powers[0] / n for of, n in zip(flats, pixels, strict=True)])
        variance = variance + tails[:, None]
    above, K, q = mean - dark.black_DN, dark.K_DN_per_e, data.q_DN
    # Frames of different brightness differ, in addition to noise, by the bin's pattern (shading, PRNU) times that.
    shift2 = np.stack([np.var(flat.shift_DN, axis=0, ddof=1) for flat in flats])
    pattern2 = np.maximum(spread**2 - variance, 0.0) / np.where(above > 0, above, np.inf) ** 2
    variance = np.maximum(variance - shift2 * pattern2, 0.0)
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
    return Levels(
        mean_DN=above,
        variance_DN2=variance,
        dof=stacked(flats, "dof"),
        samples=stacked(flats, "samples"),
        usable=usable,
        # Frames that are lit have an exposure: 0 says that it is not known.
        light=np.array([flat.light or np.nan for flat in flats]),
        dark_DN=dark.dark_DN_per_s.value * np.array([flat.exposure_s for flat in flats]),
        row_variance_DN2=np.array([dark.row_DN2.value / (flat.frames * flat.height) for flat in flats]),
    )


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
        observed = float(np.average(seen.variance_DN2, weights=seen.dof))
        # The tails are the read noise's: rounding and counts of dark current have hardly any.
        excess = excess_kurtosis(dark.shape.value) if dark.shape.there else 0.0
        tails = excess * min(read.value, observed) ** 2 * (1 - 1 / seen.frames)
        sigma = float(np.sqrt((2 * observed**2 + tails) / float(seen.dof.sum())))
        points.append((observed - rounding - K * rate * seen.exposure_s, sigma, rate * seen.exposure_s))
    values, sigmas, drifts = np.array(points).T
    # An error of black acts on the curve as an error of V0 that is K times as large.
    shifted = K * np.sqrt(max(float(dark.levels_cov[0, 0]) - dark.offsets.mean_variance, 0.0))
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


def rough_gain(data: NoiseMoments, black_DN: float, dark_DN2: float) -> float:
    """Conversion gain in DN per electron from moments alone, for the first fit of the dark frames."""
    mean = stacked(data.flats, "mean_DN") - black_DN
    variance = stacked(data.flats, "variance_DN2") - data.rounding_DN2
    lit = mean > max(0.05 * mean.max(), 0.0)
    # Clipping lowers the ratio and nothing raises it.
    return max(float(np.quantile((variance[lit] - dark_DN2) / mean[lit], 0.75)), 1e-6) if lit.any() else 1.0


def find_saturation(data: NoiseMoments, dark: DarkTerms, curve: Curve) -> tuple[float, float]:
    """Level in DN at which the signal stops, with its sigma (patterns of the offsets not counted).

    It is the mean of the bins in which every pixel is full, or the last code where codes end before the full well. In
    between, it follows from the fraction of samples at the end. Where no bin is full, full pixels may pile up.
    """
    full = [(flat, bins) for flat, bins in zip(data.flats, curve.full, strict=True) if bins.any()]
    if not full and curve.pile:
        return curve.pile
    if not full:
        # The level lies between the brightest code seen and the largest possible one.
        seen = max(flat.peak_DN for flat in data.flats)
        return data.top_DN, max(data.top_DN - seen, 0.0) / float(np.sqrt(3.0))
    peak = max(flat.peak_DN for flat, _ in full)
    # Bins in which most samples have the last code; of a whole frame, colours that are not full hide them.
    part = max(float(flat.at_peak[bins].max()) for flat, bins in full if flat.peak_DN == peak)
    V0 = max(float(curve.values[1]), 0.0)
    if part >= 0.5 and peak < data.top_DN:
        return float(peak), float(1 / np.sqrt(12.0))  # known to within rounding
    if part >= 0.5:
        # So many samples come to the converter's end from a level within half a code of it, where noise is small.
        spread = float(np.sqrt(V0 + dark.dsnu_DN2.value + dark.row_DN2.value))
        below = 0.5 * data.q_DN - spread * float(ndtri(min(part, 1 - 1e-4)))
        return float(peak), max(below, 0.0) / float(np.sqrt(3.0))
    found = np.array([_level(flat, bins, data, dark, V0, peak) for flat, bins in full])
    # An outlier among full pixels is a pixel that is not full.
    clean = (found[:, 2] > 0) & np.array([of.frames * of.outliers <= 1e-5 * of.samples.sum() for of, _ in full])
    values, variances, _ = (found[clean] if clean.any() else found).T
    weight = 1 / np.maximum(variances, 1e-12)
    return float(np.average(values, weights=weight)), float(weight.sum() ** -0.5)


def _level(
    flat: Moments, full: Bool[np.ndarray, " bins"], data: NoiseMoments, dark: DarkTerms, V0: float, peak: int
) -> tuple[float, float, bool]:
    """Saturation in DN by one flat, its variance, and whether all pixels of a bin are full."""
    temporal = V0 + data.rounding_DN2
    excess = flat.variance_DN2 - temporal
    sure = full & (excess < 3.0 * temporal * np.sqrt(2 / flat.dof))
    chosen = sure if sure.any() else full
    samples = float(flat.samples[chosen].sum())
    rows = dark.row_DN2.value / (flat.frames * flat.height) * (full.size / float(chosen.sum()))
    spread2 = V0 + dark.dsnu_DN2.value + dark.row_DN2.value
    part = float(np.average(flat.at_peak[chosen], weights=flat.samples[chosen]))
    spread, clipped = float(np.sqrt(spread2)), flat.peak_DN >= data.top_DN and part > 0.0
    z = float(ndtri(part)) if clipped else 0.0
    density = float(np.exp(-0.5 * z**2)) / math.sqrt(2 * math.pi)
    if clipped and part > _MANY_AT_THE_END:
        own = spread2 * part * (1 - part) / density**2 / samples
        # The fraction gives the level by the shape of the noise, of which the read noise's is not quite normal.
        quantile, probability = standard_cdf(dark.shape.value)
        own += V0 * (0.2 if dark.foreign else float(np.interp(part, probability, quantile)) - z) ** 2
        return peak - 0.5 * data.q_DN + spread * z, own + rows, bool(sure.any())
    # Few samples beyond the end lower the mean by this, if their noise is normal.
    lost = spread * (density + z * part) if clipped else 0.0
    # Rounding adds sum over k of (-1)^k q sin(2 pi k x / q) f(2 pi k / q) / (pi k) to the mean of noise that has the
    # characteristic function f (Widrow and Kollar, Quantization Noise, chapter 5): this is its uncertainty. Tails leave
    # more of it than normal noise does; as much as Laplace's where the fitted shape has them.
    frequency, shape = 2 * np.pi * np.arange(1, 8) / data.q_DN, dark.shape.value
    tails = dark.foreign or shape < 0
    read = 1 / (1 + 0.5 * frequency**2 * V0) if tails else smeared(shape, frequency * np.sqrt(V0))
    left = read * np.exp(-0.5 * frequency**2 * (spread2 - V0))
    rounding = float(np.sum(2 * (left / frequency) ** 2))
    # Where some pixels are not full, the possible shift of the mean adds to it.
    low = 0.0 if sure.any() else 0.5 * max(float(excess[chosen].mean()), 0.0)
    mean = float(np.average(flat.mean_DN[chosen], weights=flat.samples[chosen]))
    return mean + lost, temporal / samples + rounding + low + rows + lost**2, bool(sure.any())
