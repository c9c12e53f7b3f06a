"""The error of the map: by the parameters' covariance, by patterns in the residuals, by harmonics that are not free.

Hundreds of harmonics are too weak to be fitted, or to be fitted alone: what they may add is part of the map's sigma.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.linalg import block_diag

from udccal.fitting.engine.gaussian import Posterior, square_root
from udccal.fitting.engine.misfit import excess_variance
from udccal.fitting.engine.report import coarse
from udccal.fitting.wire.data import BLOCK, Pixels, Weighed, ideal_points, scaled_places
from udccal.fitting.wire.jacobian import block_jacobian, values_at, with_harmonics
from udccal.fitting.wire.parameters import Harmonics, Kind, Parameters, WireRules, WireStart, possible_harmonics
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire

# Places of the map's Jacobian, down and across.
_PLACES = 64
_Vector = Float[np.ndarray, " n"]
_Cov = Float[np.ndarray, "n n"]
# See ``_relative``.
_Relative = tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], float]


def _grid(geometry: Geometry, shape: tuple[int, int], parts: tuple[int, int]) -> Pixels:
    """The middles of ``parts`` (down, across) of a sensor of that shape, without values; they fill whole blocks."""
    y, x = ((np.arange(n) + 0.5) / n * size - 0.5 for n, size in zip(parts, shape, strict=True))
    at = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    zero = np.zeros(len(at))
    site = zero.astype(np.int64)
    return Pixels(ideal_points(geometry, at), scaled_places(at, shape), site, value=zero, weight=zero, place=site)


def mean_one(parameters: Parameters, x: _Vector, shape: tuple[int, int]) -> _Vector:
    """``x`` with the first coefficient of the shading that gives the map of a sensor (rows, columns) a mean of 1."""
    wire = parameters.wire(x)
    # By the midpoint rule.
    whole, base = values_at(wire, _grid(wire.geometry, shape, (192, 256)))
    scaled = x.copy()
    scaled[0] -= np.log(float(np.mean(whole * base)))
    return scaled


@final
@dataclass(frozen=True)
class MapJacobian:
    """Values of the map and their derivatives ``rows`` at a fixed mean of 1, on a grid over the sensor.

    ``of_mean`` are the derivatives of the mean where it is not fixed.
    """

    value: Float[np.ndarray, " places"]
    rows: Float[np.ndarray, "n places"]
    of_mean: _Vector

    def sigma_map(self, cov: _Cov, model: float = 0.0) -> Float32[np.ndarray, "1 16 16"]:
        """Relative sigma of the map, RMS over 16 x 16 cells; ``model`` is the relative model error."""
        variance = np.einsum("ip,ij,jp->p", self.rows, cov, self.rows, optimize=True) + (model * self.value) ** 2
        return np.sqrt(coarse(variance.reshape(1, _PLACES, _PLACES), 16)).astype(np.float32)

    def sigma(self, cov: _Cov, model: float = 0.0) -> float:
        """Relative sigma of the map, RMS over the sensor; ``model`` is the relative model error."""
        return float(np.sqrt(np.mean(np.square(self.sigma_map(cov, model), dtype=np.float64))))

    def posterior(self, parameters: Parameters, x: _Vector, cov: _Cov, model: float) -> Posterior[Wire]:
        """Posterior of the fitted parameters and of the relative model error.

        The model error is a further modulation of unknown phase. Its cosine and sine are two more parameters, so that
        it adds the same variance everywhere. To first order, the map's mean stays 1.
        """

        def term_at(values: Float[np.ndarray, " n_2"]) -> Wire:
            moved, beside = values[:-2].copy(), values[-2:]
            moved[0] -= self.of_mean @ (moved - x)
            wire = parameters.wire(moved)
            amplitudes = np.zeros(max(np.shape(wire.amplitudes), (1, 2, 1, 1)))
            amplitudes[: len(wire.amplitudes)] = wire.amplitudes
            amplitudes[0, :, 0, 0] += beside
            return replace(wire, amplitudes=amplitudes)

        factor = block_diag(square_root(cov), model * np.eye(2))
        return Posterior(np.append(x, [0.0, 0.0]), factor, term_at)


def map_jacobian(parameters: Parameters, x: _Vector, shape: tuple[int, int]) -> MapJacobian:
    """Jacobian of the map at ``x``, whose mean is 1, on a grid of places over a sensor (rows, columns)."""
    wire = parameters.wire(x)
    grid = _grid(wire.geometry, shape, (_PLACES, _PLACES))
    whole, base, rows = grid.by_block(lambda block: block_jacobian(parameters, wire, block))
    value, rows = whole * base, rows * base
    # Site gains are not in the map.
    rows[parameters.of(Kind.SITE)] = 0.0
    of_mean = rows.mean(axis=1)
    return MapJacobian(value, rows - of_mean[:, None] * value, of_mean)


@final
@dataclass(frozen=True)
class Strengths:
    """By what part each harmonic is off a round pupil's, and the information on that; 0 where no column holds it.

    The strengths of ``tied`` ones are not free in the fit. The information of one of them is that of a fit in which it
    is free, too, in units of the residuals' variance.
    """

    off: Float[np.ndarray, " harmonics"]
    known: Float[np.ndarray, " harmonics"]
    tied: Bool[np.ndarray, " harmonics"]

    @property
    def free(self) -> Bool[np.ndarray, " harmonics"]:
        """Harmonics whose strength the pixels show to be another than that of rectangular openings."""
        return np.asarray((self.known > 0) & ~self.tied)


def strengths_of(
    full: Parameters, matrix: _Cov, right: _Vector, keep: Bool[np.ndarray, " n"], values: _Vector
) -> Strengths:
    """Strengths by the normal equations of all columns, of which some are kept, with these values."""
    columns = np.full(len(full.nothing.harmonics), -1)
    # The column of each harmonic's strength in even light; -1 where there is none.
    even = np.flatnonzero(full.of(Kind.FIELD) & ~full.columns[:, 2:].any(axis=1))
    columns[full.columns[even, 1]] = even
    inside = matrix[np.ix_(keep, keep)]
    known = np.diag(matrix) - np.einsum("ka,ka->a", matrix[keep], np.linalg.solve(inside, matrix[keep]))
    known[keep] = 1 / np.diag(np.linalg.inv(inside))
    known = np.maximum(known, 1e-12 * np.diag(matrix))
    off = np.where(keep, values, (right - matrix[:, keep] @ values[keep]) / known)
    held = columns >= 0
    return Strengths(np.where(held, off[columns], 0.0), np.where(held, known[columns], 0.0), ~(held & keep[columns]))


def tied_sigma(strengths: Strengths, wire: Wire, seen: Weighed, variance: float) -> float:
    """Relative RMS of what the harmonics without a free strength may be off, at the fitted wire.

    A round pupil and the edges of the openings tie all strengths together. Those that the pixels show tell by what part
    real ones differ from that. One that is tied may be off by as much, less what the pixels tell of it, and less what
    the others take of its effect on the map. ``variance`` is that of the residuals, in units of the noise's.
    """
    held = strengths.known > 0
    if not held.any():
        return 0.0
    off, own = strengths.off[held], variance / strengths.known[held]
    # Openings that are no rectangles change weak harmonics by a larger part than strong ones.
    weak = own >= np.median(own)
    part2 = max(_departure(off, own), _departure(off[weak], own[weak]))
    shrunk = part2 / np.maximum(part2 + own, 1e-300)
    square = np.where(strengths.tied[held], (shrunk * off) ** 2 + shrunk * own, 0.0)
    effect = square @ strengths.known[held] / np.sum(seen.pixels.weight * seen.expected**2)
    others = wire.harmonics[~held]
    alone = harmonics_alone(wire, others, seen.pixels.thinned(BLOCK)) if part2 > 0 and len(others) else np.zeros(1)
    return float(np.sqrt(effect + part2 * np.var(alone)))


def _departure(off: Float[np.ndarray, " some"], own: Float[np.ndarray, " some"]) -> float:
    """Mean square part by which strengths differ, beyond their own variance."""
    found, error2, _ = excess_variance(off**2, own, np.ones(len(off)))
    # Few strengths tell how much they differ: what they may differ by more counts, too.
    return found + float(np.sqrt(error2)) if found > 0 else 0.0


@final
@dataclass(frozen=True)
class Omitted:
    """The harmonics that a fit leaves out: their relative RMS over the sensor, and by what ``part`` they are there.

    A panel has all of them, by its openings and a round pupil; a synthetic map without them has none. Together they
    are one template, whose amplitude in the residuals is the part, 1 where all are there, with ``part_sigma``.
    """

    rms: float
    part: float
    part_sigma: float

    @property
    def probability(self) -> float:
        """Probability that they are there, from 1/2 before the data.

        The expected part is 0 or 1 within the part's sigma; around 1, real pupils differ by a further 0.3.
        """
        wide = np.hypot(self.part_sigma, 0.3)
        present = -0.5 * ((self.part - 1) / wide) ** 2 - np.log(wide)
        absent = -0.5 * (self.part / self.part_sigma) ** 2 - np.log(self.part_sigma)
        return float(1.0 / (1.0 + np.exp(np.clip(absent - present, -700.0, 700.0))))

    @property
    def sigma(self) -> float:
        """Their expected part of the map's relative sigma, RMS over the sensor."""
        return self.rms * float(np.sqrt(self.probability))


def omitted(start: WireStart, wire: Wire, seen: Weighed, rules: WireRules) -> Omitted | None:
    """Look for the omitted harmonics at the fitted shape, with a round pupil; None where the fit omits none.

    The pixels may be those of the fit, since it absorbs little of hundreds of harmonics.
    """
    left_out = possible_harmonics(start, rules.least_counted, rules.least_amplitude)
    if not len(left_out.bounds):
        return None
    pixels, expected = seen.pixels, seen.expected
    # The search is for the strongest, with nine tenths of the power: the others are not worth the time.
    power = np.cumsum(left_out.bounds**2)
    strongest = left_out.orders[: int(np.searchsorted(power, 0.9 * power[-1])) + 1]
    template = harmonics_alone(wire, strongest, pixels)
    weight = pixels.weight * np.where(expected > 0, expected, 0.0)
    information = max(float(np.sum(weight * expected * template**2)), 1e-300)
    part = float(np.sum(weight * (pixels.value - expected) * template)) / information
    every = harmonics_alone(wire, left_out.orders, pixels.thinned(BLOCK))
    return Omitted(float(np.std(every)), part, information**-0.5)


def harmonics_alone(wire: Wire, orders: Float[np.ndarray, "any 2"], pixels: Pixels) -> Float[np.ndarray, " n"]:
    """The modulation by these harmonics of a round pupil, at a wire's shape."""
    plain = replace(wire, amplitudes=np.zeros((0, 2, 1, 1)))
    return values_at(with_harmonics(plain, orders, pixels), pixels)[0] - 1


def unseen(harmonics: Harmonics, searched: Pixels, rules: WireRules) -> float:
    """Relative RMS modulation that the harmonics may have though the searched pixels show none; else 0."""
    power = float(np.sum(harmonics.bounds**2)) / 2
    # The mean value is 1 apart from shading; a few outliers must not count as light.
    expected_gain = power * float(np.sum(searched.weight))
    # Rows of half the expected amplitude would still have been found.
    if expected_gain > 4.0 * rules.least_gain:
        return 0.0
    return float(np.sqrt(power * min(1.0, rules.least_gain / max(expected_gain, 1e-300))))
