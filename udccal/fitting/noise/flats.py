"""Flats: which of their bins are full or inside the sensor's range, and the photon transfer curve."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.orders import Choice
from udccal.fitting.engine.robust import OutlierRule, robust_sigma
from udccal.fitting.noise.codes import excess_kurtosis
from udccal.fitting.noise.frame_moments import Shared, stacked
from udccal.fitting.noise.moments import NoiseMoments, steadied
from udccal.fitting.noise.patterns import DarkTerms
from udccal.fitting.noise.transfer import DarkVariance, Levels, Seven, TransferFit, robust_transfer

Bins = Bool[np.ndarray, "flats bins"]


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
    apart: Seven = field(default_factory=lambda: np.zeros(7))

    @property
    def fit(self) -> TransferFit:
        """The fit of the best order."""
        assert self.choice is not None, "asked for where there are usable levels"
        return self.choice.best.fit

    @property
    def values(self) -> Seven:
        """The fit's values; zeros where there is none."""
        return np.zeros(7) if self.choice is None else self.fit.values

    @property
    def cov(self) -> Float[np.ndarray, "7 7"]:
        """Covariance of the values, with what the variances' misfit and the choice of an order add."""
        assert self.choice is not None, "asked for where there are usable levels"
        orders = self.choice.spread(self.fit.samples, lambda of: of.values)
        return np.asarray(self.fit.cov * self.fit.misfit.inflation + orders + np.outer(self.apart, self.apart))

    @property
    def usable_levels(self) -> int:
        """Exposures inside the range of the fit, the stack not counted."""
        return int(self.inside.usable[: len(self.full)].any(axis=1).sum())

    @property
    def off_its_end(self) -> int | None:
        """The brightest flat inside the range, where all of its bins were taken for outliers: that is the response."""
        usable = self.inside.usable
        brightest = int(np.argmax(np.where(usable, self.inside.mean_DN, -np.inf).max(axis=1)))
        return brightest if usable[brightest].any() and not self.levels.usable[brightest].any() else None


def fit_curve(data: NoiseMoments, dark: DarkTerms) -> Curve:
    """The curve up to 90 % of saturation, or up to less where the model describes that far better.

    Where it does not follow the model, its values have the error by which those of less light differ.
    """
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
    if not found.choice:
        return found
    # Light that is unsteady beside such a bend may be a response of another kind.
    otherwise = found.fit.order.cubic and found.fit.order.unsteady
    if not (found.fit.misfit.found or otherwise or found.off_its_end is not None):
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
    if dark.own_shot_DN2_per_s:
        # The curve knows only the shot noise of what the mean shows.
        exposure_s = np.array([[of.exposure_s] for of in flats])
        variance = variance - (dark.own_shot_DN2_per_s.value - K * dark.dark_DN_per_s.value) * exposure_s
    variance = steadied(flats, variance, above)
    # Bins keep 5 sigma of their noise and 2.5 of their shading away from the range's ends.
    temporal, uneven = 5.0 * np.sqrt(variance), np.sqrt(np.maximum(spread**2 - variance, 0.0))
    usable = (above > 0) & (above <= up_to_DN) & (mean + temporal + 2.5 * uneven < ceiling_DN) & (mean > temporal)
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
    # All bins of a level share the draws of its columns.
    drawn = np.array([[dark.columns.drawn_DN4(of.frames - 1)] for of in flats]) * usable.sum(axis=1, keepdims=True)
    dof = stacked(flats, "dof")
    dof = dof / (1 + 0.5 * dof * drawn / np.maximum(variance, 1e-9) ** 2)
    uneven2 = np.where(usable, (uneven / np.where(usable, above, 1.0)) ** 2, 0.0)
    by_bin = above, variance, dof, stacked(flats, "samples"), usable, uneven2
    return Levels(*by_bin, light, dark.dark_DN_per_s.value * exposure_s, rows + dark.unsteady_DN**2)


def _dark_variance(data: NoiseMoments, dark: DarkTerms) -> DarkVariance:
    """V0 from the histograms, and from the temporal variance of the dark stack where its frames were seen."""
    rounding, K, rate, read = data.rounding_DN2, dark.K_DN_per_e, dark.dark_DN_per_s.value, dark.read_DN2
    times = np.array([pair.exposure_s for pair in data.darks])
    # Where noise by exposure is known by itself, it does not change with the gain.
    by_gain = 0.0 if dark.own_shot_DN2_per_s else rate
    drift = by_gain * times
    # Dark signal in the pairs as their read noise depends on it: long exposures are noisier and count less.
    total = read.value + dark.row_DN2.value + rounding + dark.shot_DN2(K, 1.0) * times
    points = [(read.value, read.variance**0.5, float(np.average(drift, weights=1 / total**2)))]
    seen = data.dark_seen
    # Hits were left out of the stack: where tails of the noise were taken for hits, it shows too little.
    if seen is not None and dark.white and not dark.foreign:
        # The tails are the read noise's: rounding and counts of dark current have hardly any.
        # Hot pixels are not in the dark current, unless it is skewed.
        variance = seen.temporal_DN2 if dark.skewed else seen.near_DN2
        tails = excess_kurtosis(dark.shape.value) * min(read.value, variance) ** 2 * (1 - 1 / seen.frames)
        drawn = dark.columns.drawn_DN4(seen.frames - 1)
        sigma = float(np.sqrt((2 * variance**2 + tails) / float(seen.dof.sum()) + drawn))
        signal = by_gain * seen.exposure_s
        points.append((variance - rounding - dark.shot_DN2(K, seen.exposure_s), sigma, signal))
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
