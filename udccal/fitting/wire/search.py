"""The search for the wire far around the rig description: descents from the places that a scan finds.

The scan finds stand-off, pupil and origin by demodulation of the rows' and the columns' first harmonic. The place of
faint columns is sought beside: a part of a period on, they may fit nearly as well, and the descent may end there.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter
from scipy.special import j1

from udccal.fitting.engine.least_squares import Blocks, Solution, SolverRules, minimise
from udccal.fitting.engine.orders import bic
from udccal.fitting.wire.data import FlatNoise, Pixels, WireData, weighed
from udccal.fitting.wire.jacobian import WireProblem, expected_of, rays_at, values_at, weighed_at, with_harmonics
from udccal.fitting.wire.parameters import (
    SHAPE_NAMES,
    SOLVER,
    Harmonics,
    WireRules,
    WireStart,
    ideal_wire,
    parameters_of,
    possible_harmonics,
    shape_sigma,
    shape_vector,
    with_shape,
)
from udccal.models.wire import Wire

# Gains of the CFA sites.
_Gains = Float[np.ndarray, " sites"]
# Places of faint columns to try, in periods, and the distance within which minima are one.
_SHIFTS, _APART = np.arange(8) / 8, 1 / 32
# Descents are of one minimum where their pupils, and their rows at the field's edge, are so many periods apart.
_ONE_MINIMUM = np.array([0.5, 0.1])


@final
@dataclass(frozen=True)
class Descent:
    """A fit to a sample, and where it ended.

    ``gain`` is the chi-squared that the rows explain in the pixels of the search, ``sharpness`` that of the openings'
    edges.
    """

    problem: WireProblem
    solution: Solution[Float[np.ndarray, " n"], Blocks]
    gain: float = 0.0
    sharpness: float = 1.0

    @property
    def wire(self) -> Wire:
        """The fitted wire."""
        return self.problem.parameters.wire(self.solution.place)

    @property
    def gains(self) -> _Gains:
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
class Search:
    """A search by a flat with the rig as built, its noise and the rules."""

    data: WireData
    noise: FlatNoise
    rules: WireRules

    @property
    def harmonics(self) -> Harmonics:
        """Those that are fitted."""
        return possible_harmonics(self.data.start, self.rules.least_amplitude)

    def found(self, few: Pixels, many: Pixels) -> Descent:
        """Fit the shading alone, then stand-off and origin by demodulation of the first harmonics, then all together.

        The search uses ``few`` pixels and the strongest harmonics; the last fit uses ``many`` pixels and all harmonics.
        Rows that ``few`` do not show are searched in ``many``; without any, the shading's fit comes back.
        """
        start, rules, harmonics = self.data.start, self.rules, self.harmonics.orders
        strongest = harmonics[: rules.search_harmonics]
        for sample in (few, many):
            bare = self._shading(strongest, sample)
            sample = bare.weighs(sample, self.noise)
            places, gain = scan_rows(bare.wire, bare.gains, start, sample, rules)
            if gain >= rules.least_gain:
                break
        else:
            return Descent(replace(bare.problem, pixels=sample), bare.solution, gain)
        sharp = self._search(places, bare.gains, strongest, sample)
        weights, tried = sharp[0].weighs(many, self.noise), [(rules.sharpness[0], one) for one in sharp]
        for sharpness in rules.sharpness[1:]:
            # From where sharp edges led; only edges that these pixels prefer are finished.
            placed = (with_harmonics(one.wire, strongest, sample, sharpness) for one in sharp)
            soft = [self._descent(wire, sharp[0].gains, sample) for wire in placed]
            tried += [(sharpness, one) for one in soft if one.criterion < sharp[0].criterion]
        finished = []
        for sharpness, one in tried:
            best, *_ = likely_columns(one, weights, start)
            wire = with_harmonics(best, harmonics, few, sharpness)
            finished.append(replace(self._descent(wire, one.gains, weights), gain=gain, sharpness=sharpness))
        return min(finished, key=lambda one: one.criterion)

    def resumed(self, wire: Wire, many: Pixels) -> Descent:
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
            found.append(replace(descent, gain=float(without - with_rows) / descent.variance, sharpness=sharpness))
        return min(found, key=lambda one: one.criterion)

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
        self, places: list[Wire], gains: _Gains, harmonics: Float[np.ndarray, "harmonics 2"], sample: Pixels
    ) -> list[Descent]:
        """Descend from the places of a scan: a few steps from each, and to the end from the best.

        Those beside the best count as well, until none of them is better. Where few pixels cannot distinguish rivals,
        all of them come back, best first.
        """
        tried, beside, left = list[Descent](), list[Wire](), places
        while left:
            tried += [self._begun(place, gains, harmonics, sample) for place in left]
            left = self._beside(tried, beside, places[0], gains, sample)
            beside += left
        unfinished = _rivals(tried, self.rules.unfinished)
        rivals = _rivals((self._descent(one.wire, one.gains, sample) for one in unfinished), self.rules.rival)
        best, (count, degree) = rivals[0], self.rules.free
        if (variance := best.variance) <= self.rules.doubtful_variance:
            return rivals
        room = np.zeros((min(count, len(harmonics)), 2, degree + 1, degree + 1))
        other = self._descent(replace(best.wire, amplitudes=room), best.gains, sample)
        # Chance, or noise somewhat larger than given, must not add that many parameters.
        return [other] if other.variance < 0.95 * variance else rivals

    def _begun(
        self, place: Wire, gains: _Gains, harmonics: Float[np.ndarray, "harmonics 2"], sample: Pixels
    ) -> Descent:
        """A few steps from a place; the rows have given it, but for the origin along X."""
        placed = _demodulated(
            place, gains, sample, 0, float(place.standoff_per_pitch), float(place.footprint_per_pitch)
        )
        placed = replace(placed, depth_per_pitch=np.float64(self.data.start.depth_per_pitch))
        wire = with_harmonics(placed, harmonics, sample, self.rules.sharpness[0])
        return self._descent(wire, gains, sample, SolverRules(least_gain=1e-2, iterations=3))

    def _beside(
        self, tried: list[Descent], before: list[Wire], bare: Wire, gains: _Gains, sample: Pixels
    ) -> list[Wire]:
        """Places a period of the pupil's diameter beside the best, where none was tried; ``bare`` has no modulation.

        For a pupil of several periods, that is one zero more, or less, in its transform. The same pupil at another
        stand-off is another place. A descent may leave the place that it began at: begun at one that was given
        ``before``, it would do so again, without end.
        """
        half_field, made = float(np.ptp(rays_at(bare, sample).periods[1])) / 2, list[Wire]()
        known = [_pupil_and_standoff(one) for one in (*before, *(one.wire for one in tried))]
        for best in _rivals(tried, self.rules.unfinished):
            size, standoff = _pupil_and_standoff(best.wire)
            unit = _ONE_MINIMUM / [1.0, half_field / standoff]
            for pupil in (size - 1, size + 1):
                place = np.array([pupil, standoff])
                if pupil > 1 and not any((np.abs(place - one) <= unit).all() for one in known):
                    made.append(_demodulated(bare, gains, sample, 1, standoff, pupil))
                    # Of rivals two periods apart, the place between them counts once.
                    known.append(place)
        return made

    def _descent(
        self,
        wire: Wire,
        gains: _Gains,
        pixels: Pixels,
        solver: SolverRules = SOLVER,
        name: str = "wire, shape",
        panel: bool = True,
    ) -> Descent:
        """Descend from a wire, whose origin becomes the prior's."""
        parameters = parameters_of(wire, self.rules, gains.size, panel=panel)
        problem = WireProblem(name, parameters, pixels, parameters.prior(self.data.start, self.rules))
        return Descent(problem, minimise(problem, parameters.vector(wire, gains), solver))


def _pupil_and_standoff(wire: Wire) -> Float[np.ndarray, "2"]:
    return np.array([float(wire.footprint_per_pitch), float(wire.standoff_per_pitch)])


def _rivals(tried: Iterable[Descent], margin: float) -> list[Descent]:
    """The descents that the data so far cannot distinguish from the best one, best first."""
    ordered = sorted(tried, key=lambda one: one.solution.equations.cost)
    return [one for one in ordered if one.solution.equations.cost < ordered[0].solution.equations.cost + margin]


def likely_columns(descent: Descent, pixels: Pixels, start: WireStart, margin: float = 0.0) -> list[Wire]:
    """The wire with its origin along X moved by each eighth of a period, where that fits the pixels; the best is first.

    Chi-squared is at most ``margin`` above the lowest. The columns' openings are as built: a fit to few pixels may put
    faint columns half a period off, with openings wider than their period.
    """
    wire = replace(descent.wire, column_open=np.float64(start.column_open))
    shifted = [replace(wire, offset_periods=wire.offset_periods + np.array([shift, 0.0])) for shift in _SHIFTS]
    errors = (pixels.value - expected_of(one, descent.gains, pixels) for one in shifted)
    chi2 = np.array([np.sum(error**2 * pixels.weight) for error in errors])
    return [shifted[k] for k in np.argsort(chi2, kind="stable") if chi2[k] <= chi2.min() + margin]


def best_of_columns(here: Descent, starts: list[Wire], few: Pixels) -> tuple[Descent, Float[np.ndarray, "n n"]]:
    """The lowest of the minima that are reached from the columns' places of other wires, and the parameters' spread.

    The spread is the second moment of all minima about the lowest one, each with the weight of its likelihood. Descents
    that come back to it on ``few`` pixels are not repeated on all.
    """
    problem, first = here.problem, here.problem.parameters.linear
    offset, opening = (first + SHAPE_NAMES.index(name) for name in ("offset_x_periods", "column_open"))
    tried = [here.solution]
    for start in starts:
        x = here.solution.place.copy()
        x[offset], x[opening] = float(start.offset_periods[0]), float(start.column_open)
        x = minimise(replace(problem, pixels=few), x, SOLVER).place
        moved = x[offset] - here.solution.place[offset]
        if abs(moved - np.round(moved)) > _APART:
            tried.append(minimise(problem, x, SOLVER))
    best, *others = sorted(tried, key=lambda one: one.equations.cost)
    away, weights = [np.zeros_like(best.place)], [1.0]
    for one in others:
        moved = one.place - best.place
        moved[offset] -= np.round(moved[offset])
        if min(abs(moved[offset] - other[offset]) for other in away) > _APART:
            away.append(moved)
            weights.append(float(np.exp(0.5 * (best.equations.cost - one.equations.cost))))
    part, off = np.array(weights) / np.sum(weights), np.array(away)
    return replace(here, solution=best), np.asarray((off.T * part) @ off)


def scan_rows(
    wire: Wire, gains: _Gains, start: WireStart, pixels: Pixels, rules: WireRules
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


def _trials(ends: tuple[float, float], step: float, most: int) -> Float[np.ndarray, " n"]:
    """Logarithms of the factors to try; one factor is 1, the rig description itself."""
    low, high = np.log(ends)
    count = int(np.clip(np.ceil((high - low) / step), 8, most))
    below = max(round(count * -low / (high - low)), 1)
    return np.concatenate([np.linspace(low, 0, below + 1)[:-1], np.linspace(0, high, count - below + 1)])


def _demodulate(
    wire: Wire,
    gains: _Gains,
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
    slope = (rays.periods[axis] - wire.offset_periods[axis]) / float(wire.standoff_per_pitch)
    z = np.pi * pupils[:, None] * np.sqrt(rays.ellipse[2 * axis])
    sizes = root * 2.0 * np.sinc(rays.openings[axis]) * 2.0 * j1(z) / z
    power = np.maximum(np.sum(sizes**2, axis=1), 1e-300)
    # errors = a cos(phase + t) = a (cos t cos(phase) - sin t sin(phase)): the angle found is t.
    phases = (2 * np.pi * standoff * slope for standoff in standoffs)
    sums = np.stack([sizes @ np.stack([errors * np.cos(p), -errors * np.sin(p)], axis=1) for p in phases])
    return 2 * np.sum(sums**2, axis=-1) / power / variance, np.arctan2(sums[..., 1], sums[..., 0])


def _demodulated(wire: Wire, gains: _Gains, pixels: Pixels, axis: int, standoff: float, pupil: float) -> Wire:
    """The wire with this stand-off and pupil, and with the origin that an axis' first harmonic gives."""
    _, angle = _demodulate(wire, gains, pixels, axis, np.array([standoff]), np.array([pupil]))
    return _placed(wire, standoff, pupil, axis, angle[0, 0])


def _placed(wire: Wire, standoff: float, pupil: float, axis: int, angle: float) -> Wire:
    offset = np.array(wire.offset_periods, dtype=np.float64)
    offset[axis] = float(angle) / (2 * np.pi)
    lengths = {"standoff_per_pitch": np.float64(standoff), "footprint_per_pitch": np.float64(pupil)}
    return replace(wire, offset_periods=offset, **lengths)
