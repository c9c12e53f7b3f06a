"""Backscatter: a session's panel pictures in the dark, as a profile's term predicts them; nothing is solved for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.backscatter.data import BackscatterData, Binned
from udccal.fitting.backscatter.model import PerShot, Usable, grid_rays, ratios
from udccal.fitting.backscatter.parameters import BackscatterRules, linear_of, vector_of
from udccal.fitting.backscatter.read import read_backscatter
from udccal.models.backscatter import Backscatter
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.result import FitResult
from udccal.sessions.store import Session
from udccal.validation.checks import Check, Judged, ZMap, at_most, chi2_check, unusable
from udccal.validation.limits import ValidationLimits
from udccal.validation.patterns import Samples, bands, pattern_check

# Every so many bins of the term's grid, down and across, are predicted.
_EVERY = 4
# No panel dims white to less of its brightness.
_DIMMEST = 0.01


def validate_backscatter(profile: Profile, session: Session, limits: ValidationLimits) -> Judged:
    """Judge a session's panel pictures; see ``judge_backscatter``.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    geometry, shading = profile.backscatter.term.geometry, profile.wire_map.astype(np.float64)
    return judge_backscatter(
        read_backscatter(session, profile.noise.term, geometry, shading), profile.backscatter, limits
    )


@in_float64
def judge_backscatter(data: BackscatterData, result: FitResult[Backscatter], limits: ValidationLimits) -> Judged:
    """Judge the panel's brightness, the light of its pictures, patterns in it, and the scatter of the bins."""
    if (why := unusable_pictures(data, result.term)) is not None:
        return unusable("backscatter", why)
    seen = SeenLight.of(data, result)
    worst = int(np.argmax(np.abs(seen.z).mean(axis=(1, 2))))
    count = int(seen.usable.sum())
    checks = (
        _brightness(seen, limits),
        _light_check(seen, limits),
        _pattern_check(seen, limits),
        chi2_check(
            "backscatter",
            float(np.sum(seen.z**2)) / count,
            count,
            result.chi2_dof,
            limits.chi2_factor,
            limits,
            "Bins of the panel's pictures",
        ),
    )
    name = ("the white picture", *data.names)[worst]
    caption = f"The panel's light in {name}, seen less predicted, green, in sigma."
    return Judged(checks, ZMap(seen.z[worst, 1].reshape(seen.shape), "x", "y", caption))


def unusable_pictures(data: BackscatterData, term: Backscatter) -> str | None:
    """Return why a session's panel pictures cannot be predicted; None where they can be."""
    if not len(data.shots.rate):
        return "The white picture or the dark frame is missing. Capture the backscatter steps."
    if data.shots.rate.shape[1:] != np.shape(term.mask):
        return "The profile's grid is not that of this session's rig. Calibrate the rig again."
    if not data.shots.usable[:-1, :, ::_EVERY, ::_EVERY].any():
        return "All of the panel's pictures are clipped. Capture the backscatter steps again with shorter exposures."
    return None


@final
@dataclass(frozen=True)
class SeenLight:
    """White and the pictures at some bins of the term's grid, in e-/s.

    Attributes:
        light: predicted. off: measured less predicted. noise: its variance by noise.
        model: variance of the prediction by the model error that the profile states.
        usable: bins without clipped samples.
        shape: of the map of the bins.
    """

    light: PerShot
    off: PerShot
    noise: PerShot
    model: PerShot
    usable: Usable
    shape: tuple[int, int]

    @classmethod
    def of(cls, data: BackscatterData, result: FitResult[Backscatter]) -> SeenLight:
        """From all bins of a session, and a profile's fit."""
        term, model_error = result.term, result.diagnostic("model_error_of_white") or 0.0
        white = result.diagnostic("brightness_of_white") or 1.0
        if white >= _DIMMEST:
            # The panel limits its power: the mask is white at the pictures' brightness.
            data = replace(data, shots=data.shots.with_white(white))
        rows, columns = data.shots.rate.shape[2:]
        down, across = np.arange(0, rows, _EVERY), np.arange(0, columns, _EVERY)
        flat = (down[:, None] * columns + across).ravel()
        rays, shots = grid_rays(term.geometry, (rows, columns), term.step, flat), data.shots.at(flat)
        mask = np.asarray(term.mask, dtype=np.float64).reshape(3, -1)[:, flat]
        ratio = ratios(term, linear_of(vector_of(term)), rays, data.pictures)[:-1]
        light = mask * ratio
        noise = _noise(shots, light)
        # A profile does not keep the noise of its mask: it counts as that of a mask by this session's pictures.
        noise = noise + ratio**2 / np.sum(ratio**2 / noise, axis=0)
        model = np.broadcast_to((model_error * mask) ** 2, light.shape)
        return cls(light, shots.excess[:-1] - light, noise, model, shots.usable[:-1], (len(down), len(across)))

    @property
    def weight(self) -> PerShot:
        """Inverse variance, 0 where not usable."""
        return np.where(self.usable, 1 / (self.noise + self.model), 0.0)

    @property
    def z(self) -> PerShot:
        """Errors in units of their sigma."""
        return np.asarray(self.off * np.sqrt(self.weight))


def _noise(shots: Binned, light: PerShot) -> PerShot:
    """Variance by noise of light less that of the dark frame."""
    dark = (shots.exposure_s[-1] / shots.exposure_s[:-1])[:, None, None] ** 2 * shots.rest[-1]
    return np.asarray(shots.variance(np.concatenate([light, np.zeros_like(light[:1])]))[:-1] + dark)


def brightness(seen: SeenLight) -> Float[np.ndarray, "3"]:
    """Return the panel's light over the predicted one, by colour."""
    top, bottom = (np.sum(seen.weight * seen.light * one, axis=(0, 2)) for one in (seen.light + seen.off, seen.light))
    return np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1.0), 1.0)


def _brightness(seen: SeenLight, limits: ValidationLimits) -> Check:
    """Whether the panel is as bright as predicted."""
    level = brightness(seen)
    worst = int(np.argmax(np.abs(level - 1)))
    return at_most(
        "backscatter",
        "panel's brightness",
        100 * abs(float(level[worst]) - 1),
        limits.panel_percent,
        "%",
        f"The panel is {100 * float(level[worst]):.2f} % as bright as the profile says "
        f"({('red', 'green', 'blue')[worst]}).",
    )


def _light_check(seen: SeenLight, limits: ValidationLimits) -> Check:
    """The worst picture's error without noise, of its peak."""
    square = np.where(seen.usable, seen.off**2 - seen.noise, 0.0).sum(axis=(1, 2))
    mean = square / np.maximum(seen.usable.sum(axis=(1, 2)), 1)
    peak = np.maximum(np.maximum(seen.light, seen.light + seen.off).max(axis=(1, 2)), 1e-9)
    worst = 100 * float(np.max(np.sqrt(np.maximum(mean, 0.0)) / peak))
    return at_most(
        "backscatter",
        "panel's light, RMS, of its peak",
        worst,
        limits.backscatter_percent,
        "%",
        f"The light of {len(seen.off)} pictures is off by up to {worst:.2f} % of its peak (RMS, without noise).",
    )


def _pattern_check(seen: SeenLight, limits: ValidationLimits) -> Check:
    """Parts of the sensor that see another light than the rest; the panel's brightness is solved for."""
    light = seen.light * brightness(seen)[:, None]
    peak = np.maximum(np.maximum(light, seen.light + seen.off).max(axis=(1, 2), keepdims=True), 1e-9)
    used, shots = seen.usable, seen.light.size // seen.light.shape[2]
    parts, count = _parts(seen.shape, BackscatterRules().cells)
    group = np.arange(shots).reshape(*seen.light.shape[:2], 1) * count + parts
    off, noise, model = (seen.off + seen.light - light) / peak, seen.noise / peak**2, np.sqrt(seen.model) / peak
    return pattern_check(
        "backscatter",
        "pattern over the sensor",
        [Samples(off[used], noise[used], model[used], 0 * group[used]).pattern(group[used])],
        100.0,
        limits.panel_pattern_percent,
        "%",
        "Parts of the sensor in the panel's pictures, at the panel's own brightness,",
    )


def _parts(shape: tuple[int, int], most: int) -> tuple[Int[np.ndarray, " n"], int]:
    """Return the part of the sensor in which each bin of a map lies, and how many parts there are.

    There are at most ``most`` parts a side, of two bins a side or more where the map has them.
    """
    down, across = (int(np.clip(size // 2, 1, most)) for size in shape)
    y, x = bands(shape[0], down), bands(shape[1], across)
    return (y[:, None] * across + x).ravel(), down * across
