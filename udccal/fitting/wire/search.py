"""The search for the wire far around the rig description: descents from the places that a scan finds.

The scan finds stand-off, pupil and origin by demodulation of the rows' and the columns' first harmonic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter
from scipy.special import j1

from udccal.fitting.engine.least_squares import Blocks, Solution, SolverRules, minimise
from udccal.fitting.engine.orders import bic
from udccal.fitting.wire.columns import likely_columns
from udccal.fitting.wire.data import FlatNoise, Pixels, WireData, weighed
from udccal.fitting.wire.jacobian import WireProblem, rays_at, values_at, weighed_at, with_harmonics
from udccal.fitting.wire.parameters import parameters_of, shape_sigma, shape_vector, with_shape
from udccal.fitting.wire.rules import SOLVER, Harmonics, WireRules, WireStart, ideal_wire, possible_harmonics
from udccal.models.wire import Wire


@final
@dataclass(frozen=True)
class Descent:
    """A fit to a sample, and where it ended."""

    problem: WireProblem
    solution: Solution[Float[np.ndarray, " n"], Blocks]

    @property
    def wire(self) -> Wire:
        """The fitted wire."""
        return self.problem.parameters.wire(self.solution.place)

    @property
    def gains(self) -> Float[np.ndarray, " sites"]:
        """Gains of the CFA sites."""
        return self.problem.parameters.gains(self.solution.place)

    @property
    def variance(self) -> float:
        """Variance of the residuals in units of the noise's."""
        return self.problem.variance(self.problem.sums(self.solution.place)[2])

    @property
    def criterion(self) -> float:
        """Bayesian information criterion, to compare shapes on the same pixels."""
        return bic(self.solution.equations.cost, float(len(self.solution.place)), self.problem.pixels.used)

    def weighs(self, pixels: Pixels, noise: FlatNoise) -> Pixels:
        """A sample weighted by the fitted model."""
        return weighed_at(self.problem.parameters, self.solution.place, pixels, noise).pixels


@final
@dataclass(frozen=True)
class Found:
    """A fit whose shape is nearly final, the pixels searched, and the chi-squared that the rows explain in them.

    ``sharpness`` is that of the openings' edges.
    """

    descent: Descent
    searched: Pixels
    gain: float
    sharpness: float = 1.0


@final
@dataclass(frozen=True)
class Search:
    """A search by a flat with the rig as built, its noise and the rules."""

    data: WireData
    noise: FlatNoise
    rules: WireRules

    @property
    def harmonics(self) -> Harmonics:
        """Those that are fitted."""
        return possible_harmonics(self.data.start, self.rules.least_amplitude)

    def found(self, few: Pixels, many: Pixels) -> Found:
        """Fit the shading alone, then stand-off and origin by demodulation of the first harmonics, then all together.

        The search uses ``few`` pixels and the strongest harmonics; the last fit uses ``many`` pixels and all harmonics.
        Rows that ``few`` do not show are searched in ``many``.
        """
        start, rules = self.data.start, self.rules
        harmonics = self.harmonics.orders
        strongest = harmonics[: rules.search_harmonics]
        for sample in (few, many):
            bare = self._shading(strongest, sample)
            sample = bare.weighs(sample, self.noise)
            places, gain = scan_rows(bare.wire, bare.gains, start, sample, rules)
            if gain >= rules.least_gain:
                break
        else:
            return Found(bare, sample, gain)
        sharp = self._search(places, bare.gains, strongest, sample)
        weights, tried = sharp[0].weighs(many, self.noise), [(rules.sharpness[0], one) for one in sharp]
        for sharpness in rules.sharpness[1:]:
            # From where sharp edges led; only edges that these pixels prefer are finished.
            placed = (with_harmonics(one.wire, strongest, sample, sharpness) for one in sharp)
            soft = [self._descent(wire, sharp[0].gains, sample) for wire in placed]
            tried += [(sharpness, one) for one in soft if one.criterion < sharp[0].criterion]
        finished = []
        for sharpness, one in tried:
            best, *_ = likely_columns(one.wire, one.gains, weights, start.column_open)
            wire = with_harmonics(best, harmonics, few, sharpness)
            finished.append(Found(self._descent(wire, one.gains, weights), sample, gain, sharpness))
        return min(finished, key=lambda one: one.descent.criterion)

    def resumed(self, wire: Wire, many: Pixels) -> Found:
        """The shape and the shading of an earlier fit as they are; its corrections of the pupil are chosen anew."""
        ideal = ideal_wire(self.data.geometry, self.data.start, wire.harmonics, self.rules)
        shaped = replace(with_shape(ideal, shape_vector(wire)), baseline=wire.baseline, amplitudes=wire.amplitudes)
        whole, base = values_at(wire, many)
        # The weights are those of the earlier fit's own map.
        pixels, gains = weighed(many, whole * base, self.noise).pixels, np.ones(self.noise.floor.size)
        without, with_rows = (np.sum((many.value - of) ** 2 * pixels.weight) for of in (base, whole * base))
        found = []
        for sharpness in self.rules.sharpness:
            one = with_harmonics(shaped, wire.harmonics, many, sharpness)
            descent = self._descent(one, gains, pixels, SolverRules(iterations=0), "wire, resumed")
            found.append(Found(descent, pixels, float(without - with_rows) / descent.variance, sharpness))
        return min(found, key=lambda one: one.descent.criterion)

    def _shading(self, harmonics: Float[np.ndarray, "harmonics 2"], sample: Pixels) -> Descent:
        """Fit the shading without any panel: no modulation, and no openings that narrow with obliquity."""
        wire = ideal_wire(self.data.geometry, self.data.start, harmonics, self.rules)
        baseline = np.zeros_like(wire.baseline)
        baseline[0, 0] = -np.log(float(wire.row_open) * float(wire.column_open))
        nothing, gains = np.zeros_like(wire.fields), np.ones(self.noise.floor.size)
        wire = replace(wire, baseline=baseline, fields=nothing, depth_per_pitch=np.float64(0.0))
        # At first, clipped pixels are left out by their own values; later, by the model's.
        clip = self.noise.clip[sample.site]
        pixels = weighed(sample, np.where(sample.value < clip, 1.0, clip), self.noise).pixels
        for _ in range(2):
            descent = self._descent(wire, gains, pixels, name="wire, shading", panel=False)
            wire, gains, pixels = descent.wire, descent.gains, descent.weighs(sample, self.noise)
        return descent

    def _search(
        self,
        places: list[Wire],
        gains: Float[np.ndarray, " sites"],
        harmonics: Float[np.ndarray, "harmonics 2"],
        sample: Pixels,
    ) -> list[Descent]:
        """Descend from the places of a scan: a few steps from each, and to the end from the best.

        A pupil one period larger, with the origin half a period on, has nearly the same first harmonic. Where few
        pixels cannot distinguish such rivals, all of them come back, best first.
        """
        depth, tried = np.float64(self.data.start.depth_per_pitch), []
        for place in (places[0], *beside(places[0]), *places[1:]):
            placed = replace(scan_columns(place, gains, sample), depth_per_pitch=depth)
            wire = with_harmonics(placed, harmonics, sample, self.rules.sharpness[0])
            tried.append(self._descent(wire, gains, sample, SolverRules(least_gain=1e-2, iterations=3)))
        unfinished = _rivals(tried, self.rules.unfinished)
        rivals = _rivals([self._descent(one.wire, one.gains, sample) for one in unfinished], self.rules.rival)
        best, (count, degree) = rivals[0], self.rules.free
        if (variance := best.variance) <= self.rules.doubtful_variance:
            return rivals
        room = np.zeros((min(count, len(harmonics)), 2, degree + 1, degree + 1))
        other = self._descent(replace(best.wire, amplitudes=room), best.gains, sample)
        # Chance, or noise somewhat larger than given, must not add that many parameters.
        return [other] if other.variance < 0.95 * variance else rivals

    def _descent(
        self,
        wire: Wire,
        gains: Float[np.ndarray, " sites"],
        pixels: Pixels,
        solver: SolverRules = SOLVER,
        name: str = "wire, shape",
        panel: bool = True,
    ) -> Descent:
        """Descend from a wire, whose origin becomes the prior's."""
        parameters = parameters_of(wire, self.rules, gains.size, panel=panel)
        problem = WireProblem(name, parameters, pixels, parameters.prior(self.data.start, self.rules))
        return Descent(problem, minimise(problem, parameters.vector(wire, gains), solver))


def _rivals(tried: Sequence[Descent], margin: float) -> list[Descent]:
    """The descents that the data so far cannot distinguish from the best one, best first."""
    ordered = sorted(tried, key=lambda one: one.solution.equations.cost)
    return [one for one in ordered if one.solution.equations.cost < ordered[0].solution.equations.cost + margin]


def scan_rows(
    wire: Wire, gains: Float[np.ndarray, " sites"], start: WireStart, pixels: Pixels, rules: WireRules
) -> tuple[list[Wire], float]:
    """Wires whose stand-off, pupil and origin along Y put most signal into the rows' first harmonic, best first.

    There may be several: a pupil one period larger with the origin half a period on has nearly the same harmonic.
    ``wire`` has no modulation and the start's stand-off and pupil; ``pixels`` have its weights. The second result is
    the chi-squared that the best one's first harmonic explains, 0 where there is none.
    """
    rays, sigma = rays_at(wire, pixels), shape_sigma(start, rules)
    half_field = max(float(np.ptp(rays.periods[1])) / 2, 1.0)
    z = max(np.pi * start.footprint_per_pitch * float(np.sqrt(np.max(rays.ellipse[2]))), 1.0)
    step, step_z = rules.scan_steps
    off = _trials(rules.scan_range, step / half_field, 2500), _trials(rules.scan_range, step_z / z, 80)
    standoffs, pupils = start.standoff_per_pitch * np.exp(off[0]), start.footprint_per_pitch * np.exp(off[1])
    gain, angle = _demodulate(wire, gains, pixels, 1, standoffs, pupils)
    unlikely = (off[0] / sigma[3])[:, None] ** 2 + (off[1] / sigma[6]) ** 2
    score = np.where(gain > 0, gain - np.minimum(unlikely, 0.5 * gain), 0.0)
    # Other places count if they explain a good part of the best one's chi-squared.
    peaks = np.argwhere((maximum_filter(score, size=3, mode="nearest") == score) & (score >= 0.3 * score.max()))
    order = np.argsort([-score[i, j] for i, j in peaks], kind="stable")[: rules.places]
    found = [_placed(wire, standoffs[i], pupils[j], 1, angle[i, j]) for i, j in peaks[order]]
    return found, float(gain[tuple(peaks[order[0]])]) if found else 0.0


def beside(place: Wire) -> list[Wire]:
    """The places with a pupil one period larger or smaller, where the first harmonic's sign and the origin change.

    For a pupil of several periods, a period of diameter is one zero more, or less, in the pupil's transform.
    """
    pupil, standoff = float(place.footprint_per_pitch), float(place.standoff_per_pitch)
    angle = 2 * np.pi * (float(np.asarray(place.offset_periods)[1]) + 0.5)
    return [_placed(place, standoff, size, 1, angle) for size in (pupil - 1.0, pupil + 1.0) if size > 1.0]


def scan_columns(wire: Wire, gains: Float[np.ndarray, " sites"], pixels: Pixels) -> Wire:
    """The wire with the origin along X from the columns' first harmonic; the rows have given the rest."""
    standoff, pupil = float(wire.standoff_per_pitch), float(wire.footprint_per_pitch)
    _gain, angle = _demodulate(wire, gains, pixels, 0, np.array([standoff]), np.array([pupil]))
    return _placed(wire, standoff, pupil, 0, angle[0, 0])


def _trials(ends: tuple[float, float], step: float, most: int) -> Float[np.ndarray, " n"]:
    """Logarithms of the factors to try; one factor is 1, the rig description itself."""
    low, high = np.log(ends)
    count = int(np.clip(np.ceil((high - low) / step), 8, most))
    below = max(round(count * -low / (high - low)), 1)
    return np.concatenate([np.linspace(low, 0, below + 1)[:-1], np.linspace(0, high, count - below + 1)])


def _demodulate(
    wire: Wire,
    gains: Float[np.ndarray, " sites"],
    pixels: Pixels,
    axis: int,
    standoffs: Float[np.ndarray, " s"],
    pupils: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, "s p"], Float[np.ndarray, "s p"]]:
    """Demodulate the residuals of ``wire``: chi-squared by an axis' first harmonic, in residual variances; phase."""
    whole, base = values_at(wire, pixels)
    level = base * gains[pixels.site]
    root = np.sqrt(pixels.weight) * level
    errors = (pixels.value / level - whole) * root
    variance = max(float(np.sum(errors**2)) / max(pixels.used, 1), 1e-300)
    rays = rays_at(wire, pixels)
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
    return replace(
        wire, standoff_per_pitch=np.float64(standoff), footprint_per_pitch=np.float64(pupil), offset_periods=offset
    )
