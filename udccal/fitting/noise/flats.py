"""What flats tell: which of their bins lie inside the sensor's range, the photon transfer curve, and saturation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from udccal.fitting.engine.orders import Choice
from udccal.fitting.engine.robust import OutlierRule, robust_sigma
from udccal.fitting.noise.codes import start_values
from udccal.fitting.noise.dark import DarkTerms
from udccal.fitting.noise.data import NoiseMoments
from udccal.fitting.noise.moments import Moments
from udccal.fitting.noise.rules import NoiseRules
from udccal.fitting.noise.transfer import DarkVariance, Levels, TransferFit, choose_transfer, without_outliers

# Of all samples at one code: above the first share the codes end below the full well, below the second far above it.
_AT_END, _FAR = 0.5, 1e-3
# A level known to whole codes only.
_ROUNDING_SIGMA = float(1 / np.sqrt(12.0))

Bins = Bool[np.ndarray, "flats bins"]


@final
@dataclass(frozen=True)
class Curve:
    """The photon transfer curve and what it rests on.

    Attributes:
        choice: fits of all orders, and the best; None where no exposure is inside the range.
        full: bins at saturation, and its rough level ``ceiling_DN``.
        usable_levels: exposures inside the range of the fit, the stack not counted; and ``bins`` of them.
        bins_left_out: bins off the curve.
        levels_left_out: flats off the response (by index), beyond those whose frames differ.
        flickering: flats whose two frames differ in brightness (by index).
        fit_up_to: share of saturation that the fit reaches.
        shot_significance: shot noise of the light in all bins together, in sigma of their variances.
    """

    full: Bins
    ceiling_DN: float
    flickering: tuple[int, ...]
    fit_up_to: float
    choice: Choice[TransferFit] | None = None
    usable_levels: int = 0
    bins: int = 0
    bins_left_out: int = 0
    levels_left_out: tuple[int, ...] = ()
    shot_significance: float = 0.0

    @property
    def fit(self) -> TransferFit:
        """Of the best order."""
        assert self.choice is not None, "asked for where there are usable levels"
        return self.choice.best.fit

    @property
    def K_DN_per_e(self) -> float:
        """Conversion gain at small signals; 0 where there is no curve."""
        return float(self.fit.values[0]) if self.choice else 0.0


def fit_curve(data: NoiseMoments, dark: DarkTerms, rules: NoiseRules) -> Curve:
    """The curve up to 90 % of saturation, or up to 70 % where that is described far better."""
    quiet = dark.read_DN2.value + data.q_DN**2 / 12.0 + dark.row_DN2.value
    full = clipped(data.flats, dark.black_DN, quiet, data.top_DN, rules)
    # Upper median of the saturated bins, or the converter's largest code where there is none.
    ceiling = float(np.quantile(stacked(data.flats, "mean_DN")[full], 0.75)) if full.any() else data.top_DN
    empty = Curve(full, ceiling, _flickering(data.flats, dark, rules), rules.fit_up_to)
    found = _fitted(data, dark, empty, rules)
    if found.choice and found.fit.chi2_dof > rules.suspect_chi2:
        narrow = _fitted(data, dark, replace(empty, fit_up_to=rules.narrow_up_to), rules)
        if narrow.usable_levels >= rules.levels and narrow.fit.chi2_dof < 0.5 * found.fit.chi2_dof:
            found = narrow
    return found


def _fitted(data: NoiseMoments, dark: DarkTerms, curve: Curve, rules: NoiseRules) -> Curve:
    """The fit to the range that ``curve`` names, outliers left out."""
    levels = _bright_levels(data, dark, curve, rules)
    usable = int(levels.usable[: len(data.flats)].any(axis=1).sum())
    if usable < 1:
        return curve
    point, full_DN = _dark_variance(data, dark), max(curve.ceiling_DN - dark.black_DN, 1.0)
    choice, left = choose_transfer(levels, point, full_DN, rules), 0
    off: tuple[int, ...] = ()
    for _ in range(3):
        cleaned, bins, now_off = without_outliers(levels, choice.best.fit, rules)
        if not (bins or now_off) or not cleaned.usable[: len(data.flats)].any():
            break
        levels, left, off = cleaned, left + bins, (*off, *now_off)
        choice = choose_transfer(levels, point, full_DN, rules)
    use = levels.usable
    shot = float(choice.best.fit.values[0]) * (levels.mean_DN - levels.dark_DN[:, None])[use]
    significance = np.sqrt(np.sum(levels.dof[use] / 2 * (shot / np.maximum(levels.variance_DN2[use], 1e-9)) ** 2))
    return replace(
        curve,
        choice=choice,
        usable_levels=usable,
        bins=int(use.sum()),
        bins_left_out=left,
        levels_left_out=off,
        shot_significance=float(significance),
    )


def stacked(flats: tuple[Moments, ...], name: str) -> Float[np.ndarray, "levels bins"]:
    """A number of every flat and bin."""
    return np.stack([getattr(flat, name) for flat in flats])


def _bright_levels(data: NoiseMoments, dark: DarkTerms, curve: Curve, rules: NoiseRules) -> Levels:
    """The flats as the transfer fit takes them, with the bins that lie safely inside the sensor's range."""
    flats = data.flats if data.flat_stack.temporal is None else (*data.flats, data.flat_stack.temporal)
    mean, variance, spread = (stacked(flats, name) for name in ("mean_DN", "variance_DN2", "spread_DN"))
    above, q2, full_DN = mean - dark.black_DN, data.q_DN**2, curve.ceiling_DN - dark.black_DN
    # What frames of unlike brightness differ by beside noise: the pattern of the bin (shading, PRNU) times that.
    shift2 = np.stack([np.var(flat.shift_DN, axis=0, ddof=1) for flat in flats])
    pattern2 = np.maximum(spread**2 - variance, 0.0) / np.where(above > 0, above, np.inf) ** 2
    variance = np.maximum(variance - shift2 * pattern2, 0.0)
    temporal = rules.margin_sigma * np.sqrt(variance)
    uneven = rules.uneven_sigma * np.sqrt(np.maximum(spread**2 - variance, 0.0))
    usable = (above > 0) & (above <= curve.fit_up_to * full_DN)
    usable &= (mean + temporal + uneven < curve.ceiling_DN) & (mean > temporal)
    usable &= (spread >= rules.white_spread * data.q_DN) & (variance >= rules.white_temporal * q2)
    # Of few counts the distribution keeps its steps: rounding is white once they are smeared over a code.
    smeared = 2 * above / max(dark.K_DN_per_e, 1e-9) * (1 - np.cos(2 * np.pi * dark.K_DN_per_e / data.q_DN))
    smeared += 4 * np.pi**2 * (dark.read_DN2.value + dark.row_DN2.value) / q2
    usable &= (smeared >= rules.smeared) | (variance >= rules.coarse * q2)
    usable[list(curve.flickering)] = False
    return Levels(
        mean_DN=above,
        variance_DN2=variance,
        dof=stacked(flats, "dof"),
        samples=stacked(flats, "samples"),
        usable=usable,
        light=np.array([flat.light for flat in flats]),
        steady=np.ones(len(flats), bool),
        dark_DN=dark.dark_DN_per_s.value * np.array([flat.exposure_s for flat in flats]),
        row_variance_DN2=np.array([dark.row_DN2.value / (flat.frames * flat.height) for flat in flats]),
    )


def _dark_variance(data: NoiseMoments, dark: DarkTerms) -> DarkVariance:
    """V0 from the histograms, and from the temporal variance of the dark stack where its frames were seen."""
    rounding, K, rate = data.q_DN**2 / 12.0, dark.K_DN_per_e, dark.dark_DN_per_s.value
    drift = rate * np.array([pair.exposure_s for pair in data.darks])
    # Dark signal in the pairs as their read noise depends on it: long exposures, being noisier, tell less.
    total = dark.read_DN2.value + dark.row_DN2.value + rounding + K * drift
    points = [(dark.read_DN2.value, dark.read_DN2.variance**0.5, float(np.average(drift, weights=1 / total**2)))]
    seen = data.dark_stack.temporal
    if seen is not None and dark.white:
        observed = float(np.average(seen.variance_DN2, weights=seen.dof))
        # The read noise's tails, among rounding and counts of dark current, which have none to speak of.
        tails = dark.excess * min(dark.read_DN2.value, observed) ** 2 * (1 - 1 / data.dark_stack.frames)
        sigma = float(np.sqrt((2 * observed**2 + tails) / float(seen.dof.sum())))
        points.append((observed - rounding - K * rate * seen.exposure_s, sigma, rate * seen.exposure_s))
    values, sigmas, drifts = np.array(points).T
    # Black off by so much acts on the curve as read noise off by K times that.
    shifted = K * np.sqrt(max(float(dark.levels_cov[0, 0]) - dark.pixels_DN2, 0.0))
    return DarkVariance(values, np.hypot(np.maximum(sigmas, 1e-9), shifted), rounding, K, drifts)


def _flickering(flats: tuple[Moments, ...], dark: DarkTerms, rules: NoiseRules) -> tuple[int, ...]:
    """Flats whose frames differ in mean by more than such differences usually do, and than noise makes them."""
    found = []
    for flat in flats:
        signal = float(np.mean(flat.mean_DN)) - dark.black_DN
        noise = float(np.mean(flat.variance_DN2)) / float(flat.samples.sum() / 4) + 2 * dark.row_DN2.value / flat.height
        if signal > 0:
            found.append((float(np.ptp(flat.shift_DN.mean(axis=1))) / signal, np.sqrt(noise) / signal))
    if len(found) < 4:
        return ()
    relative, own = np.array(found).T
    wrong = OutlierRule("flats", rules.outlier_sigma).off(relative / np.hypot(robust_sigma(relative), own))
    lit = [i for i, flat in enumerate(flats) if float(np.mean(flat.mean_DN)) > dark.black_DN]
    return tuple(i for i, off in zip(lit, wrong, strict=True) if off)


def rough_gain(data: NoiseMoments) -> float:
    """Conversion gain from moments alone: what the dark frames' fit starts from."""
    black, _, dark_DN2 = (float(v) for v in start_values(data.darks)[:3])
    mean, variance = stacked(data.flats, "mean_DN") - black, stacked(data.flats, "variance_DN2") - data.q_DN**2 / 12.0
    lit = (mean > 0.05 * mean.max()) & (mean > 0)
    # Clipping lowers the ratio and nothing raises it.
    return max(float(np.quantile((variance[lit] - dark_DN2) / mean[lit], 0.75)), 1e-6) if lit.any() else 1.0


def clipped(
    flats: tuple[Moments, ...], black_DN: float, dark_DN2: float, top_code_DN: float, rules: NoiseRules
) -> Bins:
    """Bins that are saturated: variance far under what the rest predicts for their mean, and as bright as any.

    Where all flats are saturated there is no rest: then those are that show no more variance than the dark frames.
    """
    mean, variance = stacked(flats, "mean_DN") - black_DN, stacked(flats, "variance_DN2")
    bright = mean > 0.05 * (top_code_DN - black_DN)
    if not bright.any():
        return np.zeros(mean.shape, bool)
    # Saturation is a ceiling: a quiet bin well below the brightest one is something else.
    highest = bright & (mean >= 0.9 * mean.max())
    # Below saturation variance over mean is K plus a small positive part; clipping only lowers it.
    slope = variance / np.maximum(mean, 1e-9)
    collapsed: Bins = highest & (slope < rules.collapsed * float(np.quantile(slope[bright], 0.75)))
    quiet: Bins = highest & (variance <= 1.3 * dark_DN2)
    return quiet if not collapsed.any() and quiet[bright].mean() > 0.5 else collapsed


@final
@dataclass(frozen=True)
class Saturation:
    """Level in DN with its sigma (patterns of the offsets not counted), and the number of flat bins that reached it."""

    level_DN: float
    sigma_DN: float
    bins: int


def find_saturation(data: NoiseMoments, dark: DarkTerms, curve: Curve, rules: NoiseRules) -> Saturation:
    """Level at which the signal stops.

    Where the full well lies below the converter's end, the mean of the bins in which every pixel is full; where codes
    end first, that code; between, from the share of samples at the end.
    """
    full = [(flat, bins) for flat, bins in zip(data.flats, curve.full, strict=True) if bins.any()]
    if not full:
        # Somewhere from the brightest code seen to the largest there is.
        seen = max(flat.peak_DN for flat in data.flats)
        return Saturation(data.top_DN, max(data.top_DN - seen, 0.0) / float(np.sqrt(3.0)), 0)
    peak, count = max(flat.peak_DN for flat, _ in full), int(curve.full.sum())
    if max(flat.at_peak for flat, _ in full) >= _AT_END:
        # Of codes at the converter's end nothing is uncertain; a level between them is known to rounding.
        return Saturation(float(peak), _ROUNDING_SIGMA if peak < data.top_DN else 0.0, count)
    V0 = max(float(curve.fit.values[1]), 0.0) if curve.choice else 0.0
    found = [_level(flat, bins, data, dark, V0, peak, rules) for flat, bins in full]
    clean = [
        one for one, (flat, _) in zip(found, full, strict=True)
        if one[2] and flat.frames * flat.outliers <= rules.strays * float(flat.samples.sum())
    ]  # fmt: skip
    values, variances, _ = np.array(clean or found, dtype=np.float64).T
    weight = 1 / np.maximum(variances, 1e-12)
    return Saturation(float(np.average(values, weights=weight)), float(1 / np.sqrt(weight.sum())), count)


def _level(
    flat: Moments, full: Bool[np.ndarray, " bins"], data: NoiseMoments, dark: DarkTerms, V0: float, peak: int,
    rules: NoiseRules,
) -> tuple[float, float, bool]:  # fmt: skip
    """Saturation by one level, the variance of it, and whether its pixels are all full."""
    temporal = V0 + data.q_DN**2 / 12.0
    excess = flat.variance_DN2 - temporal
    sure = full & (excess < rules.full_sigma * temporal * np.sqrt(2 / flat.dof))
    chosen = sure if sure.any() else full
    samples = float(flat.samples[chosen].sum())
    rows = dark.row_DN2.value / (flat.frames * flat.height) * (full.size / float(chosen.sum()))
    spread = float(np.sqrt(V0 + dark.dsnu_DN2.value + dark.row_DN2.value))
    if peak >= data.top_DN and flat.at_peak > _FAR:
        z = float(ndtri(flat.at_peak))
        density = float(np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi))
        own = spread**2 * flat.at_peak * (1 - flat.at_peak) / density**2 / samples
        return peak - 0.5 * data.q_DN + spread * z, own + rows, bool(sure.any())
    mean = float(np.average(flat.mean_DN[chosen], weights=flat.samples[chosen]))
    level, gain = _unrounded(mean, spread, data.q_DN)
    # Of the correction for rounding a third is taken for uncertain: it rests on the shape of the noise.
    own = temporal / samples / gain**2 + ((level - mean) / 3) ** 2
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
