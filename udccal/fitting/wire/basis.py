"""The wire's least-squares problem, linearised: its columns at given pixels, summed up into normal equations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udccal.fitting.wire.slopes import SHAPE_PARAMETERS, field_columns, wire_slopes
from udccal.models.geometry import Geometry, unproject
from udccal.models.wire import Wire, log_baseline, modulation, scaled_positions, slopes
from udccal.numerics import in_float64

SITES = 4
# Residual variance in units of what noise makes: less is none at all, and what is divided by it stays finite.
LEAST_VARIANCE = 1e-12
BLOCK = 2048
# Tiles of the sensor, down and across, whose residuals are looked at as a whole.
TILES = (6, 8)
_TILE_NUMBERS = np.arange(TILES[0] * TILES[1])[:, None]


@final
class Pixels(eqx.Module):
    """A sample of the sensor with what does not change during the fit; ``weight`` 0 leaves a pixel out.

    ``place`` is the index in reading order; padding and what is no number have -1.
    """

    ideal: Float[np.ndarray, "n 2"]
    scaled: Float[np.ndarray, "n 2"]
    site: Int[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    place: Int[np.ndarray, " n"]

    def blocks(self) -> list[Pixels]:
        """In pieces of one size; samples are padded to whole blocks when they are drawn."""
        starts = range(0, len(self.value), BLOCK)
        return [jax.tree.map(lambda a, s=s: a[s : s + BLOCK], self) for s in starts]

    @property
    def used(self) -> int:
        """How many have a weight."""
        return int(np.count_nonzero(self.weight))


@final
@dataclass(frozen=True)
class Basis:
    """The linear coefficients in the order of the columns.

    First the baseline's Legendre pairs (degree in y, in x), then three CFA-site gains (the fourth follows from a mean
    of one), then the amplitudes' coefficients: a row of ``amplitudes`` per column (harmonic, phase, degree in y, in x),
    then the fields' coefficients: a row of ``fields`` per column (harmonic, phase, carrier, degree). ``groups`` numbers
    the columns that selection keeps or drops together; -1 is always kept.
    """

    baseline: Int[np.ndarray, "smooth 2"]
    amplitudes: Int[np.ndarray, "beside 4"]
    fields: Int[np.ndarray, "columns 4"]
    groups: Int[np.ndarray, " all"]

    @property
    def gains_at(self) -> int:
        """The first of the columns of CFA-site gains."""
        return len(self.baseline)

    @property
    def fixed(self) -> int:
        """Columns before the fields."""
        return len(self.baseline) + SITES - 1 + len(self.amplitudes)

    @property
    def size(self) -> int:
        """All columns."""
        return self.fixed + len(self.fields)

    def kept(self, keep: Bool[np.ndarray, " all"]) -> Basis:
        """Only the columns marked; the site gains always stay."""
        first, second = self.gains_at, self.gains_at + SITES - 1
        keep = np.concatenate([keep[:first], np.ones(SITES - 1, dtype=bool), keep[second : self.size]])
        return Basis(
            self.baseline[keep[:first]],
            self.amplitudes[keep[second : self.fixed]],
            self.fields[keep[self.fixed :]],
            self.groups[keep],
        )


@final
@dataclass(frozen=True)
class Normal:
    """Normal equations of a weighted linear problem: matrix, right side, weighted sum of squares, samples.

    ``by_tile`` is what each tile of the sensor adds to the right side.
    """

    matrix: Float[np.ndarray, "n n"]
    right: Float[np.ndarray, " n"]
    power: float
    samples: int
    by_tile: Float[np.ndarray, "tiles n"]


@in_float64
def sample_pixels(
    value: Float[np.ndarray, "rows columns"],
    variance: Float[np.ndarray, "rows columns"],
    geometry: Geometry,
    step: int,
    first: int = 0,
) -> Pixels:
    """Every ``step``-th pixel in reading order, shifted along from row to row; odd steps visit all CFA sites.

    Samples with other ``first`` below ``step`` share no pixel. Pixels of no finite positive variance get weight 0.
    """
    rows, columns = value.shape
    flat = np.arange(first, rows * columns, step)
    y, x = np.divmod(flat, columns)
    if columns % step == 0:
        x = (x + y) % columns
    # Whole blocks: one compiled function serves all. The filling has weight 0.
    count = len(flat)
    padded = -(-count // BLOCK) * BLOCK
    x, y = np.resize(x, padded), np.resize(y, padded)
    positions = np.stack([x, y], axis=-1).astype(np.float64)
    ideal = [np.asarray(_unproject(geometry, part)) for part in positions.reshape(-1, BLOCK, 2)]
    picked, seen = variance[y, x].astype(np.float64), value[y, x].astype(np.float64)
    real = (np.arange(padded) < count) & np.isfinite(seen)
    good = real & (picked > 0) & np.isfinite(picked)
    return Pixels(
        ideal=np.concatenate(ideal),
        scaled=np.asarray(scaled_positions(positions, rows, columns)),
        site=(2 * (y % 2) + x % 2).astype(np.int64),
        value=np.where(real, seen, 0.0),
        weight=np.where(good, 1.0 / np.where(good, picked, 1.0), 0.0),
        place=np.where(real, y * columns + x, -1),
    )


_unproject = jax.jit(unproject)


@jax.jit
def block_residual(wire: Wire, gains: Array, pixels: Pixels) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """(value / (gain exp(B)) - (1 + modulation), gain exp(B)) for one block."""
    slope = slopes(wire, pixels.ideal)
    base = jnp.exp(log_baseline(wire, pixels.scaled, slope)) * gains[pixels.site]
    return jnp.asarray(pixels.value) / base - 1 - modulation(wire, slope, pixels.scaled), base


def model_columns(
    wire: Wire, part: Pixels, basis: Basis, shape: bool
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "columns n"]]:
    """1 + modulation, exp(B), and the columns of the linearised model relative to exp(B), for one block.

    ``shape`` appends those of the ten shape parameters.
    """
    found = wire_slopes(wire, part.ideal, part.scaled)
    whole, base = np.asarray(found.whole), np.asarray(found.base)
    in_y, in_x = _over_the_sensor(wire, part.scaled)
    last = part.site == SITES - 1
    sites = np.stack([np.where(part.site == k, 1.0, np.where(last, -1.0, 0.0)) for k in range(SITES - 1)])
    # The baseline acts on everything: the change of exp(B) (1 + M), relative to exp(B), is (1 + M) dB.
    parts = [in_y[basis.baseline[:, 0]] * in_x[basis.baseline[:, 1]] * whole, sites * whole]
    if len(basis.amplitudes):
        harmonic, phase, degree_y, degree_x = basis.amplitudes.T
        parts.append(np.asarray(found.wave)[phase, harmonic] * in_y[degree_y] * in_x[degree_x])
    parts.append(field_columns(found, basis.fields))
    if shape:
        parts.append(np.asarray(found.shape))
    return whole, base, np.concatenate(parts)


def _over_the_sensor(
    wire: Wire, scaled: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "degrees_y n"], Float[np.ndarray, "degrees_x n"]]:
    count_y, count_x = np.shape(wire.baseline)
    return np.polynomial.legendre.legvander(scaled[:, 1], count_y - 1).T, np.polynomial.legendre.legvander(
        scaled[:, 0], count_x - 1
    ).T


def residuals(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels) -> Float[np.ndarray, " n"]:
    """value / (gain exp(B)) - (1 + modulation), pixel by pixel."""
    return residuals_and_base(wire, gains, pixels)[0]


def residuals_and_base(
    wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Residuals as above, and gain exp(B)."""
    found = [tuple(np.asarray(a) for a in block_residual(wire, gains, part)) for part in pixels.blocks()]
    residual, base = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return residual, base


def merit(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels) -> float:
    """Weighted sum of squared differences between the sample and the model."""
    residual, base = residuals_and_base(wire, gains, pixels)
    return float(np.sum((residual * base) ** 2 * pixels.weight))


def accumulate(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels, basis: Basis, shape: bool = False) -> Normal:
    """Normal equations linearised at ``wire``, block by block; ``shape`` appends the ten shape parameters.

    Field and shape columns can say the same thing: asked for together, they need priors.
    """
    size = basis.size + (SHAPE_PARAMETERS if shape else 0)
    matrix, by_tile, power = np.zeros((size, size)), np.zeros((len(_TILE_NUMBERS), size)), 0.0
    for part in pixels.blocks():
        whole, base, design = model_columns(wire, part, basis, shape)
        root = np.sqrt(part.weight) * base * gains[part.site]
        data = (part.value / (base * gains[part.site]) - whole) * root
        design *= root
        matrix += design @ design.T
        by_tile += np.where(tile_numbers(part) == _TILE_NUMBERS, data, 0.0) @ design.T
        power += float(data @ data)
    return Normal(matrix, by_tile.sum(axis=0), power, pixels.used, by_tile)


def tile_numbers(pixels: Pixels) -> Int[np.ndarray, " n"]:
    """Which tile of the sensor each pixel lies in."""
    x, y = (
        np.clip((0.5 * (pixels.scaled[:, i] + 1) * TILES[1 - i]).astype(np.int64), 0, TILES[1 - i] - 1) for i in (0, 1)
    )
    return np.asarray(y * TILES[1] + x)
