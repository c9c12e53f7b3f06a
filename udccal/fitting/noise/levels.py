"""What enters the photon transfer fit: bins of flats safely inside the sensor's range, and what darks tell beside."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from udccal.fitting.noise.dark import DarkTerms
from udccal.fitting.noise.data import NoiseData
from udccal.fitting.noise.moments import PairMoments
from udccal.fitting.noise.photon_transfer import DarkVariance, Levels

# So many sigma of a bin's noise away from saturation and from code 0, and of its shading.
_MARGIN, _UNEVEN = 5.0, 2.5
# Rounding is white in the variance where the samples spread so far, in steps of the converter.
_WHITE_SPREAD, _WHITE_TEMPORAL = 0.7, 0.2
# The power of their first harmonic is down by this (natural logarithm); beside so much variance it does not matter.
_SMEARED, _COARSE = 6.0, 30.0
OUTLIER_SIGMA = 6.0


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
        # The read noise's tails, among rounding and counts of dark current, which have none to speak of.
        tails = dark.excess * min(dark.read_DN2.value, observed) ** 2 * (1 - 1 / data.dark_stack.frames)
        sigmas.append(np.sqrt((2 * observed**2 + tails) / dof))
    # Black off by so much acts on the curve as read noise off by K times that.
    K = dark.K_DN_per_e
    shifted = K * np.sqrt(max(float(dark.levels_cov[0, 0]) - dark.pixels_DN2, 0.0))
    return DarkVariance(np.array(values), np.hypot(np.maximum(sigmas, 1e-9), shifted), rounding, K, np.array(drifts))


def _mean_drift(data: NoiseData, dark: DarkTerms) -> float:
    """Dark signal in the pairs as their read noise depends on it: long exposures, being noisier, tell less."""
    drift = dark.dark_DN_per_s.value * np.array([pair.exposure_s for pair in data.darks])
    total = dark.read_DN2.value + dark.row_DN2.value + data.q_DN**2 / 12.0 + dark.K_DN_per_e * drift
    return float(np.average(drift, weights=1 / total**2))


def flickering_pairs(flats: tuple[PairMoments, ...], dark: DarkTerms) -> tuple[int, ...]:
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
