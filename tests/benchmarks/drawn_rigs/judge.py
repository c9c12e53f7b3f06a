"""A profile against the truth of its drawn rig: each quantity keeps its limit, or the profile says that it does not."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tests.benchmarks.drawn_rigs import diffraction
from tests.benchmarks.drawn_rigs.draw import Rig
from tests.benchmarks.drawn_rigs.optics import directions, tilt_deg
from tests.benchmarks.drawn_rigs.scatter import Scatter
from tests.benchmarks.drawn_rigs.sensor import DrawnSensor
from tests.benchmarks.drawn_rigs.session import LED_REGION, WRITERS, panel_picture
from tests.benchmarks.drawn_rigs.wire import wire_map
from udccal.fitting.geometry.fit import term_at
from udccal.fitting.psf.held_out import KernelError, stated_by
from udccal.models.backscatter import backscatter_rate
from udccal.models.geometry import project_directions, tilt_rad
from udccal.models.psf import psf_kernels
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.result import FitResult, FitStatus

_PLACES, _PICTURES, _VISIBLE = 8, 5, 1e-4
# A profile that states at least this part of an error has told of it.
_TOLD = 0.5


@dataclass(frozen=True)
class Judged:
    """One quantity of a rig: its error, its limit, what the profile states of it, and the note or status that does.

    ``stated`` is one standard deviation, or the profile's own estimate of the error; nan where it states none.
    """

    name: str
    value: float
    limit: float
    unit: str
    stated: float
    said: str

    @property
    def within(self) -> bool:
        """Whether the limit is kept."""
        return self.value <= self.limit

    @property
    def told(self) -> bool:
        """Whether the profile says that the quantity may be this far off."""
        return bool(self.said) or self.stated >= _TOLD * self.value

    @property
    def ok(self) -> bool:
        """Whether nothing is silently wrong; an error that is no number is wrong."""
        return math.isfinite(self.value) and (self.within or self.told)


def judged(
    name: str, value: float, limit: float, unit: str, fit: FitResult, stated: float, words: tuple[str, ...]
) -> Judged:
    """A quantity of a fit, with the status or the first note that contains one of the words."""
    said = fit.status.name if fit.status is not FitStatus.CONVERGED else ""
    said = said or next((note for note in fit.notes for word in words if word in note), "")
    return Judged(name, float(value), limit, unit, float(stated), said)


@in_float64
def judge(profile: Profile, rig: Rig, terms: Iterable[str] = WRITERS) -> list[Judged]:
    """All quantities of docs/accuracy.md that concern these terms."""
    of_term = {"noise": _noise, "geometry": _rays, "wire": _wire, "psf": _psf, "backscatter": _scatter}
    return [one for term in terms for one in of_term[term](profile, rig)]


def _wire(profile: Profile, rig: Rig) -> list[Judged]:
    error = 100 * _rms(profile.wire_map / wire_map(rig) - 1)
    stated = profile.wire.diagnostic("wire_map_rms_sigma") or math.nan
    return [judged("wire map, RMS", error, 0.05, "%", profile.wire, stated, ("the model may be",))]


def _psf(profile: Profile, rig: Rig) -> list[Judged]:
    columns, rows = (size - 1 for size in LED_REGION)
    spread = np.mod(0.5 + np.arange(1, _PLACES + 1)[:, None] * [0.7548776662, 0.5698402910], 1.0)
    places = (0.04 + 0.92 * spread) * [rig.columns - 1, rig.rows - 1]
    true = np.stack([diffraction.kernel(rig, place, rows, columns) for place in places])
    found = np.asarray(psf_kernels(profile.psf.term, places, rows, columns))
    relative = 100 * np.sqrt(((found - true) ** 2).sum(axis=(2, 3)) / (true**2).sum(axis=(2, 3)))
    # The note repeats what is stated, and nothing is told where that is too small.
    stated = stated_by(profile.psf) or KernelError(math.nan)
    whole, faint = 100 * stated.relative_l2(found).max(axis=0), 100 * stated.relative_rms(found)
    rows_of = [
        judged(f"psf relative L2, {colour}, worst of {_PLACES} places", worst, 3.0, "%", profile.psf, of_colour, ())
        for colour, worst, of_colour in zip(("red", "green", "blue"), relative.max(axis=0), whole, strict=True)
    ]
    seen = true > _VISIBLE * true.max(axis=(2, 3), keepdims=True)
    tail = 100 * _rms(((found - true)[seen]) / true[seen])
    name = "psf where above 1e-4 of its peak, RMS of the relative error"
    return [*rows_of, judged(name, tail, 15.0, "%", profile.psf, faint, ())]


def _scatter(profile: Profile, rig: Rig) -> list[Judged]:
    scatter, worst, rng = Scatter(rig), 0.0, np.random.default_rng([rig.seed, 7])
    for _ in range(_PICTURES):
        picture = panel_picture(rng, rig)
        true = scatter.rate(picture)
        worst = max(
            worst, 100 * _rms(np.asarray(backscatter_rate(profile.backscatter.term, picture)) - true) / true.max()
        )
    fit = profile.backscatter
    stated = 100 * (fit.diagnostic("held_out_without_noise_of_peak") or math.nan)
    name = f"backscatter of {_PICTURES} new pictures, RMS, share of its peak, worst"
    return [judged(name, worst, 2.0, "%", fit, stated, ())]


def _noise(profile: Profile, rig: Rig) -> list[Judged]:
    sensor, fit = DrawnSensor(rig), profile.noise
    made = []
    for name, quantity, true, limit in (
        ("K", "K_DN_per_e", rig.noise.K_DN_per_e, 1.0),
        ("sigma_d", "sigma_d_e", sensor.sigma_d_e, 3.0),
        ("PRNU", "PRNU1288", rig.noise.PRNU, 5.0),
    ):
        one = fit.estimate(quantity)
        made.append(judged(name, 100 * abs(one.value / true - 1), limit, "%", fit, 100 * one.sigma / true, ()))
    return made


def _rays(profile: Profile, rig: Rig) -> list[Judged]:
    grid = np.linspace(0, rig.columns - 1, 17), np.linspace(0, rig.rows - 1, 13)
    pixels = np.stack(np.meshgrid(*grid), axis=-1).reshape(-1, 2)
    rays, fit = directions(rig, pixels), profile.geometry
    away = np.asarray(project_directions(fit.term, rays)) - pixels
    stated = math.nan
    if fit.cov.size:
        # The covariance that the profile keeps, in where rays land.
        x = np.array([one.value for one in fit.estimates[: len(fit.cov)]])
        values, vectors = np.linalg.eigh(fit.cov)
        steps = vectors * np.sqrt(np.maximum(values, 0.0))
        place = np.asarray(project_directions(term_at(x, fit.term.pupil_mm), rays))
        moved = [np.asarray(project_directions(term_at(x + s, fit.term.pupil_mm), rays)) - place for s in steps.T]
        stated = float(np.percentile(np.sqrt((np.stack(moved) ** 2).sum(axis=(0, 2))), 95))
    name = "projection of rays in the panel's frame, 95th percentile"
    off = float(np.percentile(np.linalg.norm(away, axis=1), 95))
    tilt = abs(float(np.rad2deg(tilt_rad(fit.term))) - tilt_deg(rig))
    sigma = next((one.sigma for one in fit.estimates if one.name == "tilt_deg"), math.nan)
    return [judged(name, off, 0.15, "px", fit, stated, ()), judged("tilt", tilt, 0.05, "deg", fit, sigma, ())]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))
