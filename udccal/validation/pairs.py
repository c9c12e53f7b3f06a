"""Captures of one kind of two sessions against each other, by the noise of both; no model of the rig is needed.

What differs from day to day is solved for: the level of a flat in each colour, and its slow change over the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtri

from udccal.bins import Bins
from udccal.cfa import cfa_named
from udccal.fitting.backscatter.model import grid_step
from udccal.fitting.engine.misfit import excess_sigma
from udccal.fitting.noise.data import NoiseRules, read_noise
from udccal.fitting.noise.frame_moments import stacked
from udccal.fitting.noise.moments import NoiseMoments, reduced
from udccal.fitting.wire.data import odd_step, scaled_places
from udccal.sessions.schema import DarkSubject, PanelSubject, StoredStep, TermName
from udccal.sessions.store import Average, Session
from udccal.validation.checks import Check, Judged, ZMap, at_most, unusable
from udccal.validation.flats import NO_PARTS, light_design, part_medians
from udccal.validation.limits import ValidationLimits
from udccal.validation.noise import dark_line

# Pixels of the flats that are compared; those beyond so many sigma are single defects.
_SAMPLES, _DEFECT = 110_000, 6.0
# Flats tell the gain up to this part of the brightest one, which may be clipped.
_UP_TO = 0.8


def compare_noise(a: Session, b: Session, limits: ValidationLimits) -> Judged:
    """Compare black level, dark current and gain by the frames of two sessions.

    Raises:
        SessionError: when a file of a session is missing or damaged.
        FitError: when the frames are not those of one sensor.
    """
    one, other = (reduced(read_noise(session), NoiseRules()) for session in (a, b))
    if one is None or other is None:
        return unusable("noise", "One of the sessions lacks pairs of dark and bright frames. Capture them.")
    (first, first_sigma), (second, second_sigma) = (_gain(seen) for seen in (one, other))
    if min(first, second) <= 0:
        why = "The flats of one of the sessions tell no gain: they are clipped, or too few of them differ in light."
        return unusable("noise", f"{why} Capture flats at several exposures, none of them clipped.")
    off, chance = 100 * abs(second / first - 1), 100 * float(np.hypot(first_sigma, second_sigma)) * _sigmas(limits)
    gain = at_most(
        "noise",
        "gain",
        off,
        max(limits.K_percent, chance),
        "%",
        f"The variance of flats grows with their mean {second / first:.4f} times as fast as in the other session.",
    )
    return Judged((*_dark_checks(one, other, limits), gain))


def _sigmas(limits: ValidationLimits) -> float:
    """What chance reaches as often as the limits allow, in sigma."""
    return -float(ndtri(limits.chance / 2))


def _dark_checks(a: NoiseMoments, b: NoiseMoments, limits: ValidationLimits) -> tuple[Check, ...]:
    (black_a, slope_a, most), (black_b, slope_b, _) = (dark_line(seen) for seen in (a, b))
    noise_DN = float(np.sqrt(max(float(a.dark_moments[0].variance_DN2.mean()), 1e-9)))
    level = at_most(
        "noise",
        "black level",
        abs(black_b - black_a) / noise_DN,
        limits.dark_sigma_d,
        "σ_d",
        f"Dark frames have a black level of {black_b:.3f} DN, and of {black_a:.3f} DN in the other session.",
    )
    current = at_most(
        "noise",
        "dark current",
        abs(slope_b - slope_a) * most / noise_DN,
        limits.dark_sigma_d,
        "σ_d",
        f"In {most:.3g} s, dark current adds {slope_b * most:.3f} DN; in the other session {slope_a * most:.3f} DN.",
    )
    return level, current


def _gain(seen: NoiseMoments) -> tuple[float, float]:
    """Slope of variance over mean in DN, and its relative sigma: photon transfer without a model of the sensor."""
    mean, variance, dof = (stacked(seen.flats, name) for name in ("mean_DN", "variance_DN2", "dof"))
    black, _, _ = dark_line(seen)
    light, dark = mean - black, float(np.mean([one.variance_DN2.mean() for one in seen.dark_moments]))
    used = (light > 0) & (light <= _UP_TO * light.max())
    light, above, weight = light[used], variance[used] - dark, dof[used] / np.maximum(variance[used], 1e-9) ** 2
    information = float(np.sum(weight * light**2))
    slope = float(np.sum(weight * light * above)) / max(information, 1e-300)
    return slope, float(np.sqrt(2 / max(information, 1e-300))) / max(abs(slope), 1e-300)


@final
@dataclass(frozen=True)
class _Flat:
    """A flat without its dark frame, at some pixels, and its variance along a line through those of all pixels."""

    signal: Float[np.ndarray, " n"]
    variance: Float[np.ndarray, " n"]

    @classmethod
    def of(cls, session: Session, place: Int[np.ndarray, " n"]) -> _Flat:
        flat, dark = (session.average(session.step(f"wire/{name}").captures[0]) for name in ("flat", "dark"))
        signal = (flat.mean - dark.mean).astype(np.float64).ravel()
        # Sample variances of few frames are too noisy to weigh single pixels.
        floor = float(dark.variance.mean()) * (1 / flat.frames + 1 / dark.frames)
        by_signal = max(float(flat.variance.mean() - dark.variance.mean()), 0.0) / max(float(signal.mean()), 1e-9)
        seen = signal[place]
        return cls(seen, floor + by_signal / flat.frames * np.maximum(seen, 0.0))


def compare_flats(a: Session, b: Session, limits: ValidationLimits) -> Judged:
    """Compare the averaged flats of two sessions, pixel by pixel: the unequal response of pixels cancels.

    Raises:
        SessionError: when a step or a file of a session is missing or damaged.
    """
    camera = a.rig.camera
    shape = camera.rows, camera.columns
    place = np.arange(0, shape[0] * shape[1], odd_step(shape[0] * shape[1], _SAMPLES))
    y, x = np.divmod(place, shape[1])
    scaled = scaled_places(np.stack([x, y], axis=-1).astype(np.float64), shape)
    site = cfa_named(camera.cfa).site_map(*shape)[y, x]
    one, other = (_Flat.of(session, place) for session in (a, b))
    if min(float(np.median(flat.signal)) for flat in (one, other)) <= 0:
        return unusable("wire", "One of the flats is not brighter than its dark frame. Capture it again.")
    ratio = other.signal / np.maximum(one.signal, 1e-9)
    sigma = np.abs(ratio) * np.sqrt(sum(flat.variance / np.maximum(flat.signal, 1e-9) ** 2 for flat in (one, other)))
    # Stuck pixels have no signal, and no sigma.
    lit, sigma = (one.signal > 0) & (other.signal > 0), np.maximum(sigma, 1e-9)
    used, light = lit, np.ones(len(ratio))
    design = light_design(scaled, site)
    for _ in range(2):  # Single defects are known once the light is.
        root = used / sigma
        light = design @ np.linalg.lstsq(design * root[:, None], ratio * root, rcond=None)[0]
        used = lit & (np.abs(ratio - light) < np.maximum(_DEFECT * sigma, 0.3 * light))
    off, variance, dof = (ratio / light - 1)[used], ((sigma / light) ** 2)[used], float(used.sum() - design.shape[1])
    cells, cell_sigma = part_medians(off, variance, scaled[used])
    if np.isnan(cells).all():
        return unusable("wire", NO_PARTS)
    excess, worst = excess_sigma(off**2, variance, np.ones(len(off)), dof), float(np.nanmax(np.abs(cells)))
    checks = (
        at_most(
            "wire",
            "flats, RMS",
            100 * excess,
            limits.wire_percent,
            "%",
            f"The flats differ by {100 * excess:.3f} % (RMS, without noise and slow changes of the light).",
        ),
        at_most(
            "wire",
            "worst part of the sensor",
            100 * worst,
            limits.cell_percent,
            "%",
            f"The part of the sensor that is farthest off is off by {100 * worst:.2f} %: dust or a smudge shows here.",
        ),
        _chi2("wire", off**2 / variance, dof, "Pixels of the flats"),
    )
    caption = "One flat over the other, median of a part of the sensor, in sigma."
    return Judged(checks, ZMap(cells / cell_sigma, "x", "y", caption))


def compare_panel(a: Session, b: Session, limits: ValidationLimits) -> Judged:
    """Compare the panel's light in the pictures that both sessions show.

    Raises:
        SessionError: when a file of a session is missing or damaged.
    """
    bins = Bins(a.rig.camera.cfa, grid_step(a.rig))
    one, other = (_pictures(session) for session in (a, b))
    shared = [(step, found) for step in one for found in other if _picture(step) == _picture(found)]
    darks = [
        [step for step in session.steps("backscatter") if isinstance(step.subject, DarkSubject)] for session in (a, b)
    ]
    if not shared or not all(darks):
        return unusable("backscatter", "The sessions have no picture in common, or a dark frame is missing.")
    pairs = [(_light(a, first, darks[0][0], bins), _light(b, second, darks[1][0], bins)) for first, second in shared]
    off, variance = (np.stack(part) for part in zip(*((y - x, v + u) for (x, v), (y, u) in pairs), strict=True))
    peaks = np.array([max(float(x.max()), float(y.max()), 1e-9) for (x, _), (y, _) in pairs])
    light = 100 * float(np.max(np.sqrt(np.maximum((off**2 - variance).mean(axis=(1, 2, 3)), 0.0)) / peaks))
    brightest = int(np.argmax([float(x.sum()) for (x, _), _ in pairs]))
    level = pairs[brightest][1][0].sum(axis=(1, 2)) / np.maximum(pairs[brightest][0][0].sum(axis=(1, 2)), 1e-9)
    worst = int(np.argmax(np.abs(level - 1)))
    checks = (
        at_most(
            "backscatter",
            "panel's brightness",
            100 * abs(float(level[worst]) - 1),
            limits.panel_percent,
            "%",
            f"The panel is {100 * float(level[worst]):.2f} % as bright as in the other session "
            f"({('red', 'green', 'blue')[worst]}).",
        ),
        at_most(
            "backscatter",
            "panel's light, RMS, of its peak",
            light,
            limits.backscatter_percent,
            "%",
            f"The light of {len(pairs)} pictures differs by up to {light:.2f} % of its peak (RMS, without noise).",
        ),
        _chi2("backscatter", (off**2 / variance).ravel(), float(off.size), "Bins of the panel's pictures"),
    )
    z = off[brightest, 1] / np.sqrt(variance[brightest, 1])
    return Judged(checks, ZMap(z, "x", "y", "The panel's light in the brightest picture, difference in sigma, green."))


def _chi2(term: TermName, square: Float[np.ndarray, " n"], dof: float, data: str) -> Check:
    """The reduced chi-squared by the noise of both sessions, which does not count: no light repeats to its noise."""
    value = float(square.sum()) / max(dof, 1.0)
    what = f"{data} of the two sessions differ by {value**0.5:.2f} times what noise explains."
    return Check(term, "chi-squared", value, None, "1", None, what)


def _pictures(session: Session) -> list[StoredStep]:
    return [step for step in session.steps("backscatter") if isinstance(step.subject, PanelSubject)]


def _picture(step: StoredStep) -> str:
    assert isinstance(step.subject, PanelSubject)
    return step.subject.picture_sha256


def _light(
    session: Session, step: StoredStep, dark_step: StoredStep, bins: Bins
) -> tuple[Float[np.ndarray, "3 a b"], Float[np.ndarray, "3 a b"]]:
    """The panel's light in bins and its variance, in DN/s, less the dark frame at about the same exposure."""
    average, dark = (session.average(one.captures[0]) for one in (step, dark_step))
    exposure_s = step.captures[0].exposure_s
    variance = _of_mean(average) + _of_mean(dark)
    return bins.mean(average.mean - dark.mean) / exposure_s, bins.variance(variance) / exposure_s**2


def _of_mean(average: Average) -> Float[np.ndarray, "rows columns"]:
    return np.asarray(average.variance / average.frames, dtype=np.float64)
