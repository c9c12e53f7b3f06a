"""The search for the wire far around the rig description: descents from the places that a scan finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import Blocks, Solution, SolverRules, Step, minimise
from udccal.fitting.engine.orders import bic
from udccal.fitting.wire.data import FlatNoise, Pixels, blocks, weighed
from udccal.fitting.wire.jacobian import block_jacobian, expected_of, weighed_at, with_harmonics
from udccal.fitting.wire.parameters import Parameters, parameters_of
from udccal.fitting.wire.rules import WireRules, WireStart, ideal_wire, possible_harmonics
from udccal.fitting.wire.scan import beside, scan_columns, scan_rows
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire

# Tiles of the sensor, down and across, whose residuals are tested as a whole.
TILES = (6, 8)
# Least residual variance in units of the noise's, so that quotients by it stay finite.
LEAST_VARIANCE = 1e-12
# Weakly determined parameters may creep on for ever: the descent ends at a tenth of a sigma, or when steps stall.
SOLVER = SolverRules(least_gain=1e-2, stalled_gain=0.1)


@final
@dataclass(frozen=True)
class WireProblem:
    """The likelihood of the parameters by a sample of weighted pixels.

    The scale of the noise is estimated with them, so that the prior's weight does not depend on how well PRNU is
    known. With the scale profiled out, minus twice the log likelihood is dof ln(chi-squared / dof).
    """

    name: str
    parameters: Parameters
    pixels: Pixels
    prior: Prior

    def equations_at(self, place: Float[np.ndarray, " n"]) -> Blocks:
        """Cost and normal equations in units of the residual variance."""
        matrix, by_tile, chi2 = self.sums(place)
        used, variance = self.pixels.used, self.variance(chi2)
        cost = max(used - len(place), 1) * float(np.log(variance))
        by_data = Blocks.dense(cost, used, matrix / variance, by_tile.sum(axis=0) / variance)
        return by_data.with_prior(self.prior, place)

    def variance(self, chi2: float) -> float:
        """Variance of the residuals in units of the noise's."""
        return chi2 / max(self.pixels.used - len(self.prior.mean), 1) + LEAST_VARIANCE

    def sums(
        self, place: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "tiles n"], float]:
        """Information by the pixels' weights, the right side by tile, and chi-squared."""
        wire, gains, size = self.parameters.wire(place), self.parameters.gains(place), len(place)
        matrix, by_tile, chi2, p = np.zeros((size, size)), np.zeros((TILES[0] * TILES[1], size)), 0.0, self.pixels
        for ideal, scaled, site, value, weight in blocks(p.ideal, p.scaled, p.site, p.value, p.weight):
            whole, base, rows = block_jacobian(self.parameters, wire, ideal, scaled, site)
            level, root = base * gains[site], np.sqrt(weight)
            errors, rows = (value - whole * level) * root, rows * (root * level)
            matrix += rows @ rows.T
            # A block is some rows of the sensor, which cross few of the tiles.
            tile = tile_numbers(scaled)
            crossed = np.unique(tile)
            by_tile[crossed] += np.where(tile == crossed[:, None], errors, 0.0) @ rows.T
            chi2 += float(errors @ errors)
        return matrix, by_tile, chi2

    def moved(self, place: Float[np.ndarray, " n"], step: Step) -> Float[np.ndarray, " n"]:
        """The place after a step."""
        return place + step.shared


def tile_numbers(scaled: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Number of the sensor's tile in which each position lies."""
    x, y = (np.clip((0.5 * (scaled[:, i] + 1) * n).astype(np.int64), 0, n - 1) for i, n in enumerate(TILES[::-1]))
    return np.asarray(y * TILES[1] + x)


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
    """A search by the rig as built, the noise and the rules."""

    start: WireStart
    noise: FlatNoise
    rules: WireRules

    def found(self, geometry: Geometry, few: Pixels, many: Pixels) -> Found:
        """Fit the shading alone, then stand-off and origin by demodulation of the first harmonics, then all together.

        The search uses ``few`` pixels and the strongest harmonics; the last fit uses ``many`` pixels and all harmonics.
        Rows that ``few`` do not show are searched in ``many``.
        """
        harmonics = possible_harmonics(self.start, self.rules.least_amplitude).orders
        strongest = harmonics[: self.rules.search_harmonics]
        built = ideal_wire(geometry, self.start, strongest, self.rules)
        for sample in (few, many):
            bare = self._shading(with_harmonics(built, strongest, sample.ideal), sample)
            sample = bare.weighs(sample, self.noise)
            places, gain = scan_rows(bare.wire, bare.gains, self.start, sample, self.rules)
            if gain >= self.rules.least_gain:
                break
        else:
            return Found(bare, sample, gain)
        first, *others = self.rules.sharpness
        sharp = self._search(places, bare, strongest, sample, first)
        weights, tried = sharp[0].weighs(many, self.noise), [(first, sharp)]
        for sharpness in others:
            # From where sharp edges led; only edges that these pixels prefer are finished.
            placed = (with_harmonics(one.wire, strongest, sample.ideal, sharpness) for one in sharp)
            soft = [self._descent(wire, sharp[0].gains, sample, SOLVER) for wire in placed]
            tried.append((sharpness, [one for one in soft if one.criterion < sharp[0].criterion]))
        finished = []
        for sharpness, rivals in tried:
            for one in rivals:
                columns = _best_columns(one, weights, self.start.column_open)
                wire = with_harmonics(columns, harmonics, few.ideal, sharpness)
                finished.append(Found(self._descent(wire, one.gains, weights, SOLVER), sample, gain, sharpness))
        return min(finished, key=lambda one: one.descent.criterion)

    def _shading(self, built: Wire, sample: Pixels) -> Descent:
        """Fit the shading without any panel: no modulation, and no openings that narrow with obliquity."""
        bare = replace(built, fields=np.zeros_like(built.fields), depth_per_pitch=np.float64(0.0))
        parameters = parameters_of(bare, self.rules, self.noise.floor.size, panel=False)
        prior, x = parameters.prior(self.start, self.rules), parameters.vector(bare, np.ones(parameters.sites))
        x[0] = -np.log(float(bare.row_open) * float(bare.column_open))
        # At first, clipped pixels are left out by their own values; later, by the model's.
        clip = self.noise.clip[sample.site]
        pixels = weighed(sample, np.where(sample.value < clip, 1.0, clip), self.noise).pixels
        for _ in range(2):
            problem = WireProblem("wire, shading", parameters, pixels, prior)
            descent = Descent(problem, minimise(problem, x, SOLVER))
            x, pixels = descent.solution.place, descent.weighs(sample, self.noise)
        return descent

    def _search(
        self,
        places: list[Wire],
        bare: Descent,
        harmonics: Float[np.ndarray, "harmonics 2"],
        sample: Pixels,
        sharpness: float,
    ) -> list[Descent]:
        """Descend from the places of a scan: a few steps from each, and to the end from the best.

        A pupil one period larger, with the origin half a period on, has nearly the same first harmonic. Where few
        pixels cannot distinguish such rivals, all of them come back, best first.
        """
        depth, tried = np.float64(self.start.depth_per_pitch), []
        for place in (places[0], *beside(places[0]), *places[1:]):
            placed = replace(scan_columns(place, bare.gains, sample), depth_per_pitch=depth)
            wire = with_harmonics(placed, harmonics, sample.ideal, sharpness)
            tried.append(self._descent(wire, bare.gains, sample, SolverRules(least_gain=1e-2, iterations=3)))
        unfinished = _rivals(tried, self.rules.unfinished)
        rivals = [self._descent(one.wire, one.gains, sample, SOLVER) for one in unfinished]
        rivals = _rivals(rivals, self.rules.rival)
        best, (count, degree) = rivals[0], self.rules.free
        if (variance := best.variance) <= self.rules.doubtful_variance:
            return rivals
        room = np.zeros((min(count, len(harmonics)), 2, degree + 1, degree + 1))
        other = self._descent(replace(best.wire, amplitudes=room), best.gains, sample, SOLVER)
        # Chance, or noise somewhat larger than given, must not add that many parameters.
        return [other] if other.variance < 0.95 * variance else rivals

    def _descent(self, wire: Wire, gains: Float[np.ndarray, " sites"], pixels: Pixels, rules: SolverRules) -> Descent:
        """Descend from a wire, whose origin becomes the prior's."""
        parameters = parameters_of(wire, self.rules, gains.size)
        problem = WireProblem("wire, shape", parameters, pixels, parameters.prior(self.start, self.rules))
        return Descent(problem, minimise(problem, parameters.vector(wire, gains), rules))


def _best_columns(descent: Descent, pixels: Pixels, column_open: float) -> Wire:
    """The best origin along X of eight in a period, with the columns' openings as built.

    A fit to few pixels may put faint columns half a period off, with openings wider than their period.
    """
    wire = replace(descent.wire, column_open=np.float64(column_open))
    shifted = [replace(wire, offset_periods=np.asarray(wire.offset_periods) + np.array([k / 8, 0.0])) for k in range(8)]
    errors = (pixels.value - expected_of(one, descent.gains, pixels) for one in shifted)
    return shifted[int(np.argmin([np.sum(error**2 * pixels.weight) for error in errors]))]


def _rivals(tried: Sequence[Descent], margin: float) -> list[Descent]:
    """The descents that the data so far cannot distinguish from the best one, best first."""
    ordered = sorted(tried, key=lambda one: one.solution.equations.cost)
    return [one for one in ordered if one.solution.equations.cost < ordered[0].solution.equations.cost + margin]
