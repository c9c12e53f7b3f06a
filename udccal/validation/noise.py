"""Noise: black level, dark current and photon transfer of a session's frames, as a profile's noise term predicts them.

The light of each flat is free: variances are predicted from means.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from udccal.fitting.engine.gaussian import square_root
from udccal.fitting.noise.data import NoiseData, NoiseRules, read_noise
from udccal.fitting.noise.frame_moments import Moments, stacked
from udccal.fitting.noise.moments import NoiseMoments, reduced
from udccal.fitting.noise.response import linear_mean, temporal_variance
from udccal.models.noise import Noise
from udccal.profiles.profile import Profile
from udccal.result import FitResult
from udccal.sessions.store import Session
from udccal.validation.checks import Check, Judged, ZMap, at_most, chi2_check, unusable
from udccal.validation.dark import bend_check, dark_pattern_check
from udccal.validation.limits import ValidationLimits
from udccal.validation.patterns import Pattern, pattern_check
from udccal.validation.prediction import Prediction

# What the photon transfer depends on; derivatives are over this part of each number.
_NAMES, _STEP = ("K_DN_per_e", "black_DN", "sigma_d_e", "sigma_row_DN", "nonlinearity"), 1e-4
# Bins are predicted up to this part of saturation, and these sigmas of noise and of shading away from its ends.
_UP_TO, _NOISE, _SHADING = 0.9, 5.0, 2.5
# Of full scale, the cubic part of a response at most.
_MOST_CUBIC = 0.5


def validate_noise(profile: Profile, session: Session, limits: ValidationLimits) -> Judged:
    """Judge a session's noise frames; see ``judge_noise``.

    Raises:
        SessionError: when a file of the session is missing or damaged.
        FitError: when the frames are not those of one sensor.
    """
    return judge_noise(read_noise(session), profile.noise, limits)


def judge_noise(data: NoiseData, result: FitResult[Noise], limits: ValidationLimits) -> Judged:
    """Judge black level, dark current, gain, patterns of dark frames and variances, and the scatter of these."""
    seen = reduced(data, NoiseRules())
    if seen is None:
        return unusable("noise", "There are no pairs of dark and bright frames. Capture the noise steps again.")
    transfer = _Transfer.of(result, seen)
    if not transfer.usable.any():
        return unusable("noise", "No flat lies between dark noise and saturation. Set up the lamp and capture again.")
    found, (gain, sigma) = transfer.prediction(), transfer.gain()
    explained = float(ndtri(1 - limits.chance / 2)) * sigma
    z = np.full(transfer.usable.shape, np.nan)
    z[transfer.usable] = found.z
    own = result.chi2_dof
    checks = (
        *_dark_checks(seen, result.term, limits),
        bend_check(seen, result.term, limits),
        dark_pattern_check(seen, result.term, limits),
        at_most(
            "noise",
            "gain",
            100 * abs(gain - 1),
            max(limits.K_percent, 100 * explained),
            "%",
            f"The variance of flats grows with their mean {gain:.4f} times as fast as the profile says.",
        ),
        pattern_check(
            "noise",
            "pattern of variances",
            transfer.patterns(),
            100.0,
            limits.K_percent,
            "%",
            "Variances of flats, by exposure and by part of the sensor, at their own gain,",
        ),
        chi2_check("noise", found.chi2 / found.dof, found.dof, own, limits.chi2_factor, limits, "Variances of flats"),
    )
    caption = "Variance of the flats, measured less predicted, in sigma. A bin is one colour site of one part."
    return Judged(checks, ZMap(z, "bin", "flat, by exposure", caption))


@final
@dataclass(frozen=True)
class _Transfer:
    """The flats' bins, and the profile's numbers in the order of ``_NAMES``; ``cov`` is theirs.

    ``cubic`` is what a response that is no parabola has beside the curvature, in 1/DN^2.
    """

    mean: Float[np.ndarray, "flats bins"]
    variance: Float[np.ndarray, "flats bins"]
    dof: Float[np.ndarray, "flats bins"]
    usable: Bool[np.ndarray, "flats bins"]
    rounding: float
    values: Float[np.ndarray, "5"]
    cov: Float[np.ndarray, "5 5"]
    cubic: float

    @classmethod
    def of(cls, result: FitResult[Noise], seen: NoiseMoments) -> _Transfer:
        """From the profile's fit, and the session's frames by exposure."""
        flats = tuple(sorted(seen.flats, key=lambda one: one.exposure_s))
        mean, variance, samples = (stacked(flats, name) for name in ("mean_DN", "variance_DN2", "samples"))
        values, cov, cubic = transfer_numbers(result)
        term, rounding = result.term, float(np.asarray(result.term.q_DN)) ** 2 / 12
        # A bin's variance and mean have a common error for light, and independent ones for read noise.
        quiet = values[0] ** 2 * max((values[0] * values[2]) ** 2 - values[3] ** 2, 0.0)
        dof = stacked(flats, "dof")
        dof = dof / (1 + 0.5 * dof * quiet / samples / np.maximum(variance, 1e-9) ** 2)
        return cls(mean, variance, dof, _inside(flats, term), rounding, values, cov, cubic)

    def predicted(self, values: Float[np.ndarray, "5"]) -> Float[np.ndarray, " n"]:
        """Variance of the usable bins in DN^2."""
        K, black, sigma_d, row, curvature = values
        signal = linear_mean(self.mean[self.usable] - black, curvature, self.cubic, K)
        floor = (K * sigma_d) ** 2 - row**2
        return np.asarray(temporal_variance(signal, K, floor, curvature, self.rounding, cubic=self.cubic))

    def prediction(self) -> Prediction:
        """Errors of the variances, and the share of the profile's own error."""
        expected = np.maximum(self.predicted(self.values), 1e-9)
        sigma = expected * np.sqrt(2 / self.dof[self.usable])
        z = (self.variance[self.usable] - expected) / sigma
        steps = _STEP * np.maximum(np.abs(self.values), _STEP)
        slopes = [
            (self.predicted(self.values - e) - self.predicted(self.values + e)) / (2 * step) / sigma
            for step, e in zip(steps, np.diag(steps), strict=True)
        ]
        return Prediction(z, np.zeros((len(z), 0)), np.transpose(slopes) @ square_root(self.cov))

    def patterns(self) -> tuple[Pattern, Pattern]:
        """What bins of a flat share, and what flats share in a bin, relative to the variance; the gain is free."""
        found, expected = self.prediction(), np.maximum(self.predicted(self.values), 1e-9)
        sigma = np.sqrt(2 / self.dof[self.usable])
        along = (expected - self._floor) / expected / sigma
        own = (along / max(float(np.linalg.norm(along)), 1e-300))[:, None]
        free = Prediction(found.z - own @ (own.T @ found.z), own, found.by_profile)
        flat, part = np.nonzero(self.usable)
        unit2 = float(np.mean(sigma**2))
        by_flat, by_part = (free.pattern(group) for group in (flat, part))
        return Pattern(by_flat[0], by_flat[1] ** 2 * unit2), Pattern(by_part[0], by_part[1] ** 2 * unit2)

    @property
    def _floor(self) -> float:
        """Variance at no light in DN^2, without row noise."""
        K, _, sigma_d, row, _ = self.values
        return float((K * sigma_d) ** 2 - row**2 + self.rounding)

    def gain(self) -> tuple[float, float]:
        """The gain by these flats over the profile's, by weighted least squares; and its sigma, by both errors."""
        expected, floor = self.predicted(self.values), self._floor
        light, weight = expected - floor, self.dof[self.usable] / np.maximum(expected, 1e-9) ** 2 / 2
        information = float(np.sum(weight * light**2))
        ratio = float(np.sum(weight * light * (self.variance[self.usable] - floor)) / information)
        return ratio, float(np.hypot(information**-0.5, self.cov[0, 0] ** 0.5 / self.values[0]))


def transfer_numbers(
    result: FitResult[Noise],
) -> tuple[Float[np.ndarray, "5"], Float[np.ndarray, "5 5"], float]:
    """Return the numbers of photon transfer and their covariance, and the response's cubic part [1/DN^2].

    They are K [DN/e], black level [DN], dark noise [e], row noise [DN] and curvature [1/DN]. The curvature of a
    straight response is 0 and certain.
    """
    term, names = result.term, [one.name for one in result.estimates[: len(result.cov)]]
    span = float(np.asarray(term.saturation_DN)) - float(np.asarray(term.black_DN))
    bent = result.estimate("nonlinearity").value if "nonlinearity" in names else 0.0
    # A response that is no parabola has the term's at full scale only.
    cubic = float(np.clip(result.diagnostic("curvature_growth") or 0.0, *(np.array([-1, 1]) * _MOST_CUBIC / span**2)))
    curvature = bent / span - cubic * span
    values = np.array([*(float(np.asarray(getattr(term, name))) for name in _NAMES[:-1]), curvature])
    cov, known = np.zeros((5, 5)), [name for name in _NAMES if name in names]
    to, at = [_NAMES.index(name) for name in known], [names.index(name) for name in known]
    cov[np.ix_(to, to)] = result.cov[np.ix_(at, at)]
    unit = np.array([1.0, 1.0, 1.0, 1.0, 1 / span])
    return values, cov * np.outer(unit, unit), cubic


def _inside(flats: tuple[Moments, ...], term: Noise) -> Bool[np.ndarray, "flats bins"]:
    """Bins that lie safely between the dark and the end of the range."""
    black, top = float(np.asarray(term.black_DN)), float(np.asarray(term.saturation_DN))
    mean, variance, spread = (stacked(flats, name) for name in ("mean_DN", "variance_DN2", "spread_DN"))
    noise = _NOISE * np.sqrt(np.maximum(variance, 0.0))
    shading = _SHADING * np.sqrt(np.maximum(spread**2 - variance, 0.0))
    above = mean - black
    return np.asarray((above > noise) & (above <= _UP_TO * (top - black)) & (mean + noise + shading < top))


def dark_line(seen: NoiseMoments) -> tuple[float, float, float]:
    """Return the dark frames' mean at no exposure in DN, its change in DN/s, and the longest exposure in s."""
    exposure = np.array([one.exposure_s for one in seen.dark_moments])
    mean = np.array([one.level_DN for one in seen.dark_moments])
    slope, start = np.polyfit(exposure, mean, 1) if np.ptp(exposure) > 0 else (0.0, mean.mean())
    return float(start), float(slope), float(exposure.max())


def _dark_checks(seen: NoiseMoments, term: Noise, limits: ValidationLimits) -> tuple[Check, ...]:
    """The dark frames' means by exposure against the profile's."""
    K, black, rate, noise = (
        float(np.asarray(getattr(term, name)))
        for name in ("K_DN_per_e", "black_DN", "dark_current_e_per_s", "sigma_d_e")
    )
    unit, (level, by_time, most) = K * noise, dark_line(seen)
    start, slope = level - black, by_time - K * rate
    return (
        at_most(
            "noise",
            "black level",
            abs(start) / unit,
            limits.dark_sigma_d,
            "σ_d",
            f"Dark frames have a black level of {black + start:.3f} DN; the profile says {black:.3f} DN.",
        ),
        at_most(
            "noise",
            "dark current",
            abs(slope) * most / unit,
            limits.dark_sigma_d,
            "σ_d",
            f"In {most:.3g} s, dark current adds {(K * rate + slope) * most:.3f} DN; the profile says "
            f"{K * rate * most:.3f} DN.",
        ),
    )
