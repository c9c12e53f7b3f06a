"""Where the wire is, far around the rig description: a scan by demodulation, and descents from the places it finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter
from scipy.special import j1

from udccal.fitting.engine.least_squares import Solution, SolverRules, minimise
from udccal.fitting.wire.data import FlatNoise, Pixels, weighed
from udccal.fitting.wire.jacobian import WireEquations, WireProblem, expected_of, rays_at, values_at, with_harmonics
from udccal.fitting.wire.parameters import Parameters, ideal_wire, parameters_of, possible_harmonics, shape_sigma
from udccal.fitting.wire.rules import WireRules, WireStart
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire

_MOST_STANDOFFS, _MOST_PUPILS = 2500, 80
# Other places are looked into that explain at least this part of what the best does.
_PART = 0.3
# What the data hardly show may creep on for ever: a tenth of a sigma, or what steps of a sigma no longer bring.
_TO_THE_END = SolverRules(least_gain=1e-2, stalled_gain=0.1)
_A_FEW_STEPS = SolverRules(least_gain=1e-2, iterations=3)
# Amplitudes that no pupil explains must lower the residual variance to this part.
_WORTH = 0.95
_SHIFTS = np.arange(8) / 8


@final
@dataclass(frozen=True)
class Descent:
    """A fit to a sample: its parameters, and where it ended."""

    parameters: Parameters
    solution: Solution[Float[np.ndarray, " n"], WireEquations]

    @property
    def wire(self) -> Wire:
        """As fitted."""
        return self.parameters.wire(self.solution.place)

    @property
    def gains(self) -> Float[np.ndarray, "4"]:
        """Of the CFA sites."""
        return self.parameters.gains(self.solution.place)

    @property
    def variance(self) -> float:
        """Of the residuals, in units of what noise makes."""
        return self.solution.equations.variance


@final
@dataclass(frozen=True)
class Found:
    """A fit whose shape is nearly final, where it was searched, and what the rows' first harmonic explains there."""

    descent: Descent
    searched: Pixels
    gain: float
    present: bool


@final
@dataclass(frozen=True)
class Place:
    """A wire as demodulation finds it, and the chi-squared that its first harmonic explains."""

    wire: Wire
    gain: float


@final
@dataclass(frozen=True)
class Search:
    """What a search goes by: the rig as built, the noise, the rules."""

    start: WireStart
    noise: FlatNoise
    rules: WireRules

    def found(self, geometry: Geometry, few: Pixels, many: Pixels) -> Found:
        """The shading alone; stand-off and origin by demodulation of the first harmonics; then all of it together.

        Searches on ``few`` pixels with the strongest harmonics, and finishes on ``many`` with all of them. Rows that
        ``few`` do not show are looked for in ``many``.
        """
        harmonics = possible_harmonics(self.start, self.rules.least_amplitude).orders
        strongest = harmonics[: self.rules.search_harmonics]
        built = ideal_wire(geometry, self.start, strongest, self.rules)
        for sample in (few, many):
            bare, sample = self._shading(with_harmonics(built, strongest, sample.ideal), sample)
            places = scan_rows(bare.wire, bare.gains, self.start, sample, self.rules)
            best = places[0].gain if places else 0.0
            if best >= self.rules.least_gain:
                break
        else:
            return Found(bare, sample, best, False)
        rivals = self._search(places, bare, strongest, sample)
        weights = weighed(many, expected_of(rivals[0].wire, rivals[0].gains, many), self.noise).pixels
        finished = [
            self._descent(
                with_harmonics(self._best_columns(one, weights), harmonics, few.ideal), one.gains, weights, _TO_THE_END
            )
            for one in rivals
        ]
        return Found(_rivals(finished, self.rules.rival)[0], sample, best, True)

    def _shading(self, built: Wire, sample: Pixels) -> tuple[Descent, Pixels]:
        """Without any panel: no waves, and nothing that narrows with obliquity; and the sample weighed by it."""
        bare = eqx.tree_at(
            lambda w: (w.fields, w.depth_per_pitch), built, (np.zeros_like(built.fields), np.float64(0.0))
        )
        parameters = parameters_of(bare, self.rules, panel=False)
        x, clip = parameters.vector(bare, np.ones(4)), self.noise.clip[sample.site]
        x[0] = -np.log(float(bare.row_open) * float(bare.column_open))
        # To begin with, pixels that clip are left out by their own values; later, by the model's.
        expected = np.where(sample.value < clip, 1.0, clip)
        for _ in range(2):
            pixels = weighed(sample, expected, self.noise).pixels
            problem = WireProblem("wire, shading", parameters, pixels, parameters.prior(self.start, self.rules))
            descent = Descent(parameters, minimise(problem, x, _TO_THE_END))
            x, expected = descent.solution.place, expected_of(descent.wire, descent.gains, sample)
        return descent, weighed(sample, expected, self.noise).pixels

    def _search(
        self, places: list[Place], bare: Descent, harmonics: Float[np.ndarray, "harmonics 2"], sample: Pixels
    ) -> list[Descent]:
        """Descents from the places of a scan: a few steps from each, and to the end from the best.

        A pupil one period larger, with the origin half a period on, has nearly the same first harmonic: where few
        pixels cannot tell, all such rivals come back, best first.
        """
        depth, tried = np.float64(self.start.depth_per_pitch), []
        for place in (places[0], *beside(places[0]), *places[1:]):
            placed = scan_columns(place.wire, bare.gains, sample)
            placed = eqx.tree_at(lambda w: w.depth_per_pitch, placed, depth)
            wire = with_harmonics(placed, harmonics, sample.ideal)
            tried.append(self._descent(wire, bare.gains, sample, _A_FEW_STEPS))
        ended = [
            self._descent(one.wire, one.gains, sample, _TO_THE_END) for one in _rivals(tried, self.rules.unfinished)
        ]
        rivals = _rivals(ended, self.rules.rival)
        best, degrees = rivals[0], self.rules.free_degree + 1
        if best.variance <= self.rules.doubtful_variance:
            return rivals
        room = np.zeros((min(self.rules.free_harmonics, len(harmonics)), 2, degrees, degrees))
        free = eqx.tree_at(lambda w: w.amplitudes, best.wire, room)
        other = self._descent(free, best.gains, sample, _TO_THE_END)
        return [other] if other.variance < _WORTH * best.variance else rivals

    def _descent(self, wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels, rules: SolverRules) -> Descent:
        """From a wire, whose origin becomes the prior's."""
        parameters = parameters_of(wire, self.rules)
        problem = WireProblem("wire, shape", parameters, pixels, parameters.prior(self.start, self.rules))
        return Descent(parameters, minimise(problem, parameters.vector(wire, gains), rules))

    def _best_columns(self, descent: Descent, pixels: Pixels) -> Wire:
        """Origin along X, with the columns as wide as built.

        In few pixels, faint columns may have been seen half a period off, with openings wider than their period.
        """
        at, built = np.asarray(descent.wire.offset_periods), np.float64(self.start.column_open)
        shifted = [
            eqx.tree_at(lambda w: (w.offset_periods, w.column_open), descent.wire, (at + np.array([shift, 0.0]), built))
            for shift in _SHIFTS
        ]
        chi2 = [
            float(np.sum((pixels.value - expected_of(wire, descent.gains, pixels)) ** 2 * pixels.weight))
            for wire in shifted
        ]
        return shifted[int(np.argmin(chi2))]


def _rivals(tried: Sequence[Descent], margin: float) -> list[Descent]:
    """Those that the data seen so far cannot tell from the best, best first."""
    ordered = sorted(tried, key=lambda one: one.solution.equations.cost)
    return [one for one in ordered if one.solution.equations.cost < ordered[0].solution.equations.cost + margin]


def scan_rows(
    wire: Wire, gains: Float[np.ndarray, "4"], start: WireStart, pixels: Pixels, rules: WireRules
) -> list[Place]:
    """Stand-offs, pupils and origins along Y that put most of the signal into the rows' first harmonic, best first.

    There may be several: a pupil one period larger with the origin half a period on has nearly the same harmonic.

    Args:
        wire: without waves; at the start's stand-off and pupil.
        gains: of the CFA sites.
        start: the rig as built.
        pixels: weighed by ``wire``.
        rules: for the scan's range and steps.
    """
    rays = rays_at(wire, pixels.ideal)
    half_field = max(float(np.ptp(rays.periods[1])) / 2, 1.0)
    standoffs = start.standoff_per_pitch * _trials(rules.scan_range, rules.scan_periods / half_field, _MOST_STANDOFFS)
    z = np.pi * start.footprint_per_pitch * float(np.sqrt(np.max(rays.ellipse[2])))
    pupils = start.footprint_per_pitch * _trials(rules.scan_range, rules.scan_z / max(z, 1.0), _MOST_PUPILS)
    gain, angle = _demodulate(wire, gains, pixels, 1, standoffs, pupils)
    sigma = shape_sigma(start, rules)
    unlikely = (np.log(standoffs / start.standoff_per_pitch) / sigma[3])[:, None] ** 2
    unlikely = unlikely + (np.log(pupils / start.footprint_per_pitch) / sigma[6]) ** 2
    score = np.where(gain > 0, gain - np.minimum(unlikely, 0.5 * gain), 0.0)
    peaks = np.argwhere((maximum_filter(score, size=3, mode="nearest") == score) & (score >= _PART * score.max()))
    order = np.argsort([-score[i, j] for i, j in peaks], kind="stable")[: rules.places]
    return [Place(_placed(wire, standoffs[i], pupils[j], 1, angle[i, j]), float(gain[i, j])) for i, j in peaks[order]]


def beside(place: Place) -> list[Place]:
    """The places with a pupil one period larger or smaller: the first harmonic's sign changes, and with it the origin.

    In the pupil's transform a period of diameter is one zero more, or less, for a pupil of several periods.
    """
    pupil, standoff = float(place.wire.footprint_per_pitch), float(place.wire.standoff_per_pitch)
    angle = 2 * np.pi * (float(np.asarray(place.wire.offset_periods)[1]) + 0.5)
    other = (pupil - 1.0, pupil + 1.0)
    return [Place(_placed(place.wire, standoff, size, 1, angle), place.gain) for size in other if size > 1.0]


def scan_columns(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels) -> Wire:
    """The origin along X from the columns' first harmonic; the rest is known from the rows."""
    standoff, pupil = float(wire.standoff_per_pitch), float(wire.footprint_per_pitch)
    _gain, angle = _demodulate(wire, gains, pixels, 0, np.array([standoff]), np.array([pupil]))
    return _placed(wire, standoff, pupil, 0, angle[0, 0])


def _trials(ends: tuple[float, float], step: float, most: int) -> Float[np.ndarray, " n"]:
    low, high = np.log(ends)
    count = int(np.clip(np.ceil((high - low) / step), 8, most))
    # One of the steps is the rig description itself.
    below = max(round(count * -low / (high - low)), 1)
    return np.exp(np.concatenate([np.linspace(low, 0, below + 1)[:-1], np.linspace(0, high, count - below + 1)]))


def _demodulate(
    wire: Wire,
    gains: Float[np.ndarray, "4"],
    pixels: Pixels,
    axis: int,
    standoffs: Float[np.ndarray, " s"],
    pupils: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, "s p"], Float[np.ndarray, "s p"]]:
    """Of what ``wire`` leaves: chi-squared by an axis' first harmonic, in residual variances, and its phase."""
    whole, base = values_at(wire, pixels.ideal, pixels.scaled)
    level = base * gains[pixels.site]
    root = np.sqrt(pixels.weight) * level
    errors = (pixels.value / level - whole) * root
    variance = max(float(np.sum(errors**2)) / max(pixels.used, 1), 1e-300)
    rays = rays_at(wire, pixels.ideal)
    slope = (rays.periods[axis] - np.asarray(wire.offset_periods)[axis]) / float(wire.standoff_per_pitch)
    z = np.pi * pupils[:, None] * np.sqrt(rays.ellipse[2 * axis])
    sizes = root * 2.0 * np.sinc(rays.openings[axis]) * 2.0 * j1(z) / z
    power = np.maximum(np.sum(sizes**2, axis=1), 1e-300)
    # errors = a cos(phase + t) = a (cos t cos(phase) - sin t sin(phase)): the angle found is t.
    phases = (2 * np.pi * standoff * slope for standoff in standoffs)
    sums = np.stack([sizes @ np.stack([errors * np.cos(p), -errors * np.sin(p)], axis=1) for p in phases])
    return 2 * np.sum(sums**2, axis=-1) / power / variance, np.arctan2(sums[..., 1], sums[..., 0])


def _placed(wire: Wire, standoff: float, pupil: float, axis: int, angle: float) -> Wire:
    offset = np.array(wire.offset_periods, dtype=np.float64)
    offset[axis] = float(angle) / (2 * np.pi)
    leaves = np.float64(standoff), np.float64(pupil), offset
    return eqx.tree_at(lambda w: (w.standoff_per_pitch, w.footprint_per_pitch, w.offset_periods), wire, leaves)
