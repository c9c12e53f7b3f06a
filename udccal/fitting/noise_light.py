"""All that flats tell, given the dark frames: gain, curvature, saturation and PRNU."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from udccal.fitting import nonuniformity, photon_transfer
from udccal.fitting.noise_dark import DarkTerms
from udccal.fitting.noise_data import NoiseData
from udccal.fitting.noise_moments import PairMoments
from udccal.fitting.noise_saturation import Plateau, Saturation, clipped, find_saturation, rough_level
from udccal.fitting.photon_transfer import DarkVariance, Levels, Order, TransferFit
from udccal.fitting.read_noise import start_values

# Bins up to here, of saturation; so many sigma of their noise away from it and from code 0, and of their shading.
_FIT_UP_TO, _MARGIN, _UNEVEN = 0.9, 5.0, 2.5
# EMVA 1288 fits the photon transfer curve up to 70 % of saturation: taken where the wider range is not described.
_NARROW = 0.7
# Rounding is white in the variance where the samples spread so far, in steps of the converter.
_WHITE_SPREAD, _WHITE_TEMPORAL = 0.7, 0.2
# The power of their first harmonic is down by this (natural logarithm); beside so much variance it does not matter.
_SMEARED, _COARSE = 6.0, 30.0
OUTLIER_SIGMA = 6.0
_SUSPECT_CHI2 = 2.0


@dataclass(frozen=True)
class LightTerms:
    """What flats tell.

    Attributes:
        transfer: gain, read noise, curvature, response.
        order: which of them the data ask for.
        tried: BIC of every order.
        full_DN: saturation above black.
        saturation: where the signal stops.
        prnu: variance of the relative response of pixels.
        usable_levels: exposures inside the range of the fit, the stack not counted.
        bins_left_out: bins off the curve.
        levels_left_out: flats off the response (by index), beyond those whose frames differ.
        flickering: flats whose two frames differ in brightness (by index).
        fit_up_to: share of saturation that the fit reaches.
        shot_significance: shot noise of the light in all bins together, in sigma of their variances.
        copies: the frames of the pairs do not differ.
        stack_clipped: the flat stack reaches saturation.
    """

    transfer: TransferFit
    order: Order
    tried: tuple[tuple[Order, float], ...]
    full_DN: float
    saturation: Saturation
    prnu: nonuniformity.Unevenness
    usable_levels: int
    bins: int
    bins_left_out: int
    levels_left_out: tuple[int, ...]
    flickering: tuple[int, ...]
    fit_up_to: float
    shot_significance: float
    copies: bool
    stack_clipped: bool

    @property
    def K_DN_per_e(self) -> float:
        """Conversion gain at small signals."""
        return float(self.transfer.values[0])

    @property
    def nonlinearity(self) -> float:
        """Share of the signal that is missing at full scale."""
        return float(self.transfer.values[2]) * self.full_DN

    @property
    def bent_too_far(self) -> bool:
        """The curvature ran into its bound."""
        return abs(self.nonlinearity) >= 0.999 * photon_transfer.MOST_BENT


def fit_light_terms(data: NoiseData, dark: DarkTerms) -> LightTerms:
    """Fit all that is bright."""
    floor = dark.read_DN2.value + data.q_DN**2 / 12.0
    full = clipped(data.flats, dark.black_DN, floor + dark.row_DN2.value, data.top_DN)
    ceiling = rough_level(data.flats, full, data.top_DN)
    all_flats = data.flats if data.flat_stack.temporal is None else (*data.flats, data.flat_stack.temporal)
    flickering = _flickering(data.flats, dark)
    found = _transfer(data, dark, all_flats, ceiling, flickering, _FIT_UP_TO)
    if found.fit.chi2_dof > _SUSPECT_CHI2 or found.usable_levels == 0:
        narrow = _transfer(data, dark, all_flats, ceiling, flickering, _NARROW)
        if narrow.usable_levels >= 3 and narrow.fit.chi2_dof < 0.5 * found.fit.chi2_dof:
            found = narrow
    prnu = _prnu(data, dark, found.fit)
    after = max(float(found.fit.values[1]), 0.0) + data.q_DN**2 / 12.0
    plateau = Plateau(after, dark.dsnu_DN2.value, dark.row_DN2.value, data.q_DN)
    variances = np.stack([flat.variance_DN2 for flat in data.flats])
    means = np.stack([flat.mean_DN for flat in data.flats])
    lit = (means < dark.black_DN + 0.9 * (ceiling - dark.black_DN)) & (means > dark.black_DN)
    return LightTerms(
        transfer=found.fit,
        order=found.order,
        tried=found.tried,
        full_DN=max(ceiling - dark.black_DN, 1.0),
        saturation=find_saturation(data.flats, full, plateau, data.top_DN),
        prnu=prnu,
        usable_levels=found.usable_levels,
        bins=found.bins,
        bins_left_out=found.bins_left_out,
        levels_left_out=found.levels_left_out,
        flickering=flickering,
        fit_up_to=found.fit_up_to,
        shot_significance=found.shot_significance,
        copies=bool(lit.any()) and float(np.median(variances[lit])) < 0.3 * floor,
        stack_clipped=_stack_clipped(data, dark, found.fit, ceiling),
    )


def rough_gain(data: NoiseData) -> float:
    """Conversion gain from moments alone, good to a few per cent: what the dark frames' fit starts from."""
    black, _, dark_DN2 = (float(v) for v in start_values(data.darks)[:3])
    mean = np.stack([flat.mean_DN for flat in data.flats]) - black
    variance = np.stack([flat.variance_DN2 for flat in data.flats]) - dark_DN2 - data.q_DN**2 / 12.0
    lit = mean > 0.05 * mean.max()
    # Clipping lowers the ratio and nothing raises it.
    return max(float(np.quantile(variance[lit] / mean[lit], 0.75)), 1e-6) if lit.any() else 1.0


@dataclass(frozen=True)
class _Found:
    fit: TransferFit
    order: Order
    tried: tuple[tuple[Order, float], ...]
    usable_levels: int
    bins: int
    bins_left_out: int
    levels_left_out: tuple[int, ...]
    fit_up_to: float
    shot_significance: float


def _transfer(
    data: NoiseData,
    dark: DarkTerms,
    flats: tuple[PairMoments, ...],
    ceiling: float,
    flickering: tuple[int, ...],
    fit_up_to: float,
) -> _Found:
    levels = bright_levels(flats, dark, ceiling, fit_up_to, data.q_DN, flickering)
    point = dark_variance(data, dark)
    full_DN = max(ceiling - dark.black_DN, 1.0)
    usable = int(levels.usable[: len(data.flats)].any(axis=1).sum())
    if usable < 1:
        nothing = TransferFit(
            np.zeros(5), np.zeros((5, 5)), 0.0, 0.0, 0.0, False, np.zeros(levels.usable.shape), np.zeros(len(flats))
        )
        return _Found(nothing, Order(), (), 0, 0, 0, (), fit_up_to, 0.0)
    fit, order, tried = photon_transfer.choose_transfer(levels, point, full_DN)
    left = 0
    off: tuple[int, ...] = ()
    for _ in range(3):
        cleaned, bins, now_off = photon_transfer.without_outliers(levels, fit, OUTLIER_SIGMA)
        if not (bins or now_off) or not cleaned.usable[: len(data.flats)].any():
            break
        levels, left, off = cleaned, left + bins, (*off, *now_off)
        fit, order, tried = photon_transfer.choose_transfer(levels, point, full_DN)
    return _Found(
        fit, order, tried, usable, int(levels.usable.sum()), left, off, fit_up_to, _shot_significance(levels, fit)
    )


def _shot_significance(levels: Levels, fit: TransferFit) -> float:
    use = levels.usable
    shot = float(fit.values[0]) * (levels.mean_DN - levels.dark_DN[:, None])[use]
    return float(np.sqrt(np.sum(levels.dof[use] / 2 * (shot / np.maximum(levels.variance_DN2[use], 1e-9)) ** 2)))


def bright_levels(
    flats: tuple[PairMoments, ...],
    dark: DarkTerms,
    ceiling_DN: float,
    fit_up_to: float,
    q_DN: int,
    flickering: tuple[int, ...],
) -> Levels:
    """The flats as the transfer fit takes them, with the bins that lie safely inside the sensor's range."""
    mean, variance, spread = (
        np.stack([getattr(flat, name) for flat in flats]) for name in ("mean_DN", "variance_DN2", "spread_DN")
    )
    above = mean - dark.black_DN
    # What two frames of unlike brightness differ by beside noise: the pattern of the bin (shading, PRNU) times that.
    relative = np.stack([flat.shift_DN for flat in flats]) / np.where(above > 0, above, np.inf)
    variance = np.maximum(variance - 0.5 * relative**2 * np.maximum(spread**2 - variance, 0.0), 0.0)
    usable: Bool[np.ndarray, "levels bins"] = above <= fit_up_to * (ceiling_DN - dark.black_DN)
    temporal = _MARGIN * np.sqrt(variance)
    uneven = _UNEVEN * np.sqrt(np.maximum(spread**2 - variance, 0.0))
    usable &= (mean + temporal + uneven < ceiling_DN) & (mean > temporal) & (above > 0)
    usable &= (spread >= _WHITE_SPREAD * q_DN) & (variance >= _WHITE_TEMPORAL * q_DN**2)
    # Of few counts the distribution keeps its steps: rounding is white once they are smeared over a code.
    counts = above / max(dark.K_DN_per_e, 1e-9)
    smeared = 2 * counts * (1 - np.cos(2 * np.pi * dark.K_DN_per_e / q_DN))
    smeared += 4 * np.pi**2 * (dark.read_DN2.value + dark.row_DN2.value) / q_DN**2
    usable &= (smeared >= _SMEARED) | (variance >= _COARSE * q_DN**2)
    usable[list(flickering)] = False
    times = np.array([flat.exposure_s for flat in flats])
    return Levels(
        mean_DN=above,
        variance_DN2=variance,
        dof=np.stack([flat.dof for flat in flats]),
        samples=np.stack([flat.samples for flat in flats]),
        usable=usable,
        light=np.array([flat.light for flat in flats]),
        steady=np.ones(len(flats), bool),
        dark_DN=dark.dark_DN_per_s.value * times,
        row_variance_DN2=np.array([dark.row_DN2.value / (flat.frames * flat.height) for flat in flats]),
    )


def dark_variance(data: NoiseData, dark: DarkTerms) -> DarkVariance:
    """V0 from the histograms, and from the temporal variance of the dark stack where its frames were seen."""
    rounding = data.q_DN**2 / 12.0
    values, sigmas = [dark.read_DN2.value], [np.sqrt(dark.read_DN2.variance)]
    drifts = [_mean_drift(data, dark)]
    seen = data.dark_stack.temporal
    if seen is not None and dark.white:
        observed = float(np.average(seen.variance_DN2, weights=seen.dof))
        dof = float(seen.dof.sum())
        drift = dark.dark_DN_per_s.value * seen.exposure_s
        drifts.append(drift)
        values.append(observed - rounding - drift * dark.K_DN_per_e)
        sigmas.append(observed * np.sqrt((2 + dark.excess * (1 - 1 / data.dark_stack.frames)) / dof))
    # Black off by so much acts on the curve as read noise off by K times that.
    K = dark.K_DN_per_e
    shifted = K * np.sqrt(max(float(dark.levels_cov[0, 0]) - dark.pixels_DN2, 0.0))
    return DarkVariance(np.array(values), np.hypot(np.maximum(sigmas, 1e-9), shifted), rounding, K, np.array(drifts))


def _mean_drift(data: NoiseData, dark: DarkTerms) -> float:
    """Dark signal in the pairs as their read noise depends on it: long exposures, being noisier, tell less."""
    drift = dark.dark_DN_per_s.value * np.array([pair.exposure_s for pair in data.darks])
    total = dark.read_DN2.value + dark.row_DN2.value + data.q_DN**2 / 12.0 + dark.K_DN_per_e * drift
    return float(np.average(drift, weights=1 / total**2))


def _flickering(flats: tuple[PairMoments, ...], dark: DarkTerms) -> tuple[int, ...]:
    """Flats whose frames differ in mean by more than 6 robust sigma of what such differences usually are."""
    signal = np.array([float(np.mean(flat.mean_DN)) - dark.black_DN for flat in flats])
    noise = np.array(
        [
            float(np.mean(flat.variance_DN2)) / float(flat.samples.sum() / 4) + 2 * dark.row_DN2.value / flat.height
            for flat in flats
        ]
    )
    lit = signal > 0
    if lit.sum() < 4:
        return ()
    relative = np.array([float(np.mean(flat.shift_DN)) for flat in flats]) / np.where(lit, signal, np.inf)
    own = np.sqrt(noise) / np.where(lit, signal, np.inf)
    usual = 1.4826 * float(np.median(np.abs(relative[lit])))
    wrong = lit & (np.abs(relative) > OUTLIER_SIGMA * np.hypot(usual, own))
    return tuple(int(i) for i in np.flatnonzero(wrong))


def _prnu(data: NoiseData, dark: DarkTerms, fit: TransferFit) -> nonuniformity.Unevenness:
    """From the stacks; the temporal variance that averaging left comes from the photon transfer curve."""
    K, V0, c = (float(v) for v in fit.values[:3])
    bright, stack = data.flat_stack, data.dark_stack
    quiet = max(V0, 0.0) + data.q_DN**2 / 12.0
    rate = dark.dark_DN_per_s.value
    at_no_light = (quiet + K * rate * bright.exposure_s) / bright.frames
    if dark.white:
        signal = bright.mean_DN.astype(np.float32) - stack.mean_DN.astype(np.float32)
        at_no_light += (quiet + K * rate * stack.exposure_s) / stack.frames
    else:
        # Dark codes that are cut off or coarse do not show the offsets: their variance is taken off instead.
        signal = bright.mean_DN.astype(np.float32) - np.float32(dark.black_DN + rate * bright.exposure_s)
        at_no_light += dark.dsnu_DN2.value
    level = max(float(np.median(signal)), 1e-6)
    z = float(photon_transfer.linear_signal(np.array(level), c, K))
    steep = 1 - 2 * c * z
    found = nonuniformity.prnu(signal, at_no_light, K * z * steep**2 / level / bright.frames, data.period)
    # Where the response bends, a relative change of light is a smaller relative change of signal.
    scale = (level / (z * steep)) ** 2
    offsets = 0.0 if dark.white else float(np.sqrt(dark.dsnu_DN2.variance)) / level**2
    sigma = float(np.hypot(found.sigma, offsets)) * scale
    return replace(found, variance=found.variance * scale, sigma=sigma)


def _stack_clipped(data: NoiseData, dark: DarkTerms, fit: TransferFit, ceiling: float) -> bool:
    level = float(np.median(data.flat_stack.mean_DN))
    return level > ceiling - 4 * float(np.sqrt(max(fit.values[0], 0.0) * max(ceiling - dark.black_DN, 1.0)))
