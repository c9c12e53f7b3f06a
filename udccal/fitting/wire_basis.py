"""The wire's least-squares problem, linearised: its columns at given pixels, summed up into normal equations."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udccal.models.geometry import Geometry, unproject
from udccal.models.wire import (
    Wire,
    carriers,
    field_powers,
    kappa,
    legendre,
    log_baseline,
    modulation,
    scaled_positions,
    slopes,
    waves,
)
from udccal.numerics import in_float64

SITES = 4
SHAPE_PARAMETERS = 10
_BLOCK = 4096
# Of differences: the shortest period in any parameter is some 3e-4 / 2 pi, the rounding of a value 1e-16.
_STEP = 1e-7


class Pixels(eqx.Module):
    """A sample of the sensor with what does not change during the fit; ``weight`` 0 leaves a pixel out."""

    ideal: Float[np.ndarray, "n 2"]
    scaled: Float[np.ndarray, "n 2"]
    site: Int[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]

    def blocks(self) -> list[Pixels]:
        """In pieces of one size; samples are padded to whole blocks when they are drawn."""
        names = ("ideal", "scaled", "site", "value", "weight")
        starts = range(0, len(self.value), _block(len(self.value)))
        return [Pixels(*(getattr(self, n)[s : s + _block(len(self.value))] for n in names)) for s in starts]


def _block(samples: int) -> int:
    return min(_BLOCK, samples)


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
    def fixed(self) -> int:
        """Columns before the fields."""
        return len(self.baseline) + SITES - 1 + len(self.amplitudes)

    @property
    def size(self) -> int:
        """All columns."""
        return self.fixed + len(self.fields)


@dataclass(frozen=True)
class Normal:
    """Normal equations of a weighted linear problem: matrix, right side, weighted sum of squares, samples."""

    matrix: Float[np.ndarray, "n n"]
    right: Float[np.ndarray, " n"]
    power: float
    samples: int


@in_float64
def sample_pixels(
    value: Float[np.ndarray, "rows columns"],
    variance: Float[np.ndarray, "rows columns"],
    geometry: Geometry,
    step: int,
) -> Pixels:
    """Every ``step``-th pixel in reading order, shifted along from row to row; odd steps visit all CFA sites."""
    rows, columns = value.shape
    flat = np.arange(0, rows * columns, step)
    y, x = np.divmod(flat, columns)
    if columns % step == 0:
        x = (x + y) % columns
    # Whole blocks: one compiled function serves all. The filling has weight 0.
    count = len(flat)
    block = _block(count)
    padded = -(-count // block) * block
    x, y = np.resize(x, padded), np.resize(y, padded)
    positions = np.stack([x, y], axis=-1).astype(np.float64)
    ideal = [np.asarray(_unproject(geometry, part)) for part in positions.reshape(-1, block, 2)]
    picked = np.where(np.arange(padded) < count, variance[y, x].astype(np.float64), 0.0)
    return Pixels(
        ideal=np.concatenate(ideal),
        scaled=np.asarray(scaled_positions(positions, rows, columns)),
        site=(2 * (y % 2) + x % 2).astype(np.int64),
        value=value[y, x].astype(np.float64),
        weight=np.where(picked > 0, 1.0 / np.where(picked > 0, picked, 1.0), 0.0),
    )


_unproject = jax.jit(unproject)


def move(wire: Wire, steps: Float[np.ndarray, "10"] | Float[Array, "10"]) -> Wire:
    """Change the ten shape parameters.

    In this order: rotation (3, rad), log stand-off, offset (2), log pupil, row and column openings, depth.
    """
    return eqx.tree_at(
        lambda w: (
            w.rotation,
            w.standoff_per_pitch,
            w.offset,
            w.pupil_per_pitch,
            w.row_open,
            w.column_open,
            w.depth_per_pitch,
        ),
        wire,
        (
            wire.rotation + steps[:3],
            wire.standoff_per_pitch * jnp.exp(steps[3]),
            wire.offset + steps[4:6],
            wire.pupil_per_pitch * jnp.exp(steps[6]),
            wire.row_open + steps[7],
            wire.column_open + steps[8],
            wire.depth_per_pitch + steps[9],
        ),
    )


@jax.jit
def block_residual(wire: Wire, gains: Array, pixels: Pixels) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """(value / (gain exp(B)) - (1 + modulation), gain exp(B)) for one block."""
    slope = slopes(wire, pixels.ideal)
    base = jnp.exp(log_baseline(wire, pixels.scaled, slope)) * gains[pixels.site]
    return jnp.asarray(pixels.value) / base - 1 - modulation(wire, slope, pixels.scaled), base


@functools.partial(jax.jit, static_argnames=("shape",))
def _smooth_columns(
    wire: Wire, gains: Array, pixels: Pixels, baseline: Array, amplitudes: Array, shape: bool
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, "fixed n"]]:
    slope = slopes(wire, pixels.ideal)
    residual, base = block_residual(wire, gains, pixels)
    count = jnp.shape(wire.baseline)[0]
    in_x, in_y = legendre(pixels.scaled[:, 0], count), legendre(pixels.scaled[:, 1], count)
    last = pixels.site == SITES - 1
    sites = jnp.stack([jnp.where(pixels.site == k, 1.0, jnp.where(last, -1.0, 0.0)) for k in range(SITES - 1)])
    # The baseline acts on everything: the change of exp(B) (1 + M), relative to exp(B), is (1 + M) dB.
    whole = 1 + modulation(wire, slope, pixels.scaled)
    parts = [in_y[baseline[:, 0]] * in_x[baseline[:, 1]] * whole, sites * whole]
    if len(amplitudes):
        harmonic, phase, degree_y, degree_x = amplitudes.T
        parts.append(waves(wire, slope)[phase, harmonic] * in_y[degree_y] * in_x[degree_x])
    if shape:
        # One difference after the other: derivatives of all ten at once take five times as long, and longer to compile.
        def slope_of(steps: Float[Array, "10"]) -> Float[Array, " n"]:
            there, base_there = block_residual(move(wire, steps), gains, pixels)
            return (residual * base - there * base_there) / jnp.sum(steps)

        parts.append(jax.lax.map(slope_of, _STEP * jnp.eye(SHAPE_PARAMETERS)) / base)
    return residual, base, jnp.concatenate(parts)


@jax.jit
def _field_factors(wire: Wire, pixels: Pixels) -> tuple[Array, Array, Array]:
    slope = slopes(wire, pixels.ideal)
    seen = kappa(wire, slope)
    return (
        waves(wire, slope),
        carriers(wire, slope, seen),
        field_powers(wire, seen, jnp.shape(wire.fields)[-1]),
    )


def _field_columns(wire: Wire, pixels: Pixels, fields: Int[np.ndarray, "columns 4"]) -> Float[np.ndarray, "columns n"]:
    wave, carrier, powers = (np.asarray(part) for part in _field_factors(wire, pixels))
    h, p, c, d = fields.T
    return wave[p, h] * carrier[c, h] * powers[d, h]


def residuals(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels) -> Float[np.ndarray, " n"]:
    """value / (gain exp(B)) - (1 + modulation), pixel by pixel."""
    return np.concatenate([np.asarray(block_residual(wire, gains, part)[0]) for part in pixels.blocks()])


def merit(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels) -> float:
    """Weighted sum of squared differences between the sample and the model."""
    total = 0.0
    for part in pixels.blocks():
        residual, base = (np.asarray(a) for a in block_residual(wire, gains, part))
        total += float(np.sum((residual * base) ** 2 * part.weight))
    return total


def accumulate(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels, basis: Basis, shape: bool = False) -> Normal:
    """Normal equations linearised at ``wire``, block by block; ``shape`` appends the ten shape parameters.

    Field columns and shape columns are not asked for together: they can say the same thing.
    """
    size = basis.size + (SHAPE_PARAMETERS if shape else 0)
    matrix, right, power, samples = np.zeros((size, size)), np.zeros(size), 0.0, 0
    for part in pixels.blocks():
        residual, base, design = (
            np.asarray(a) for a in _smooth_columns(wire, gains, part, basis.baseline, basis.amplitudes, shape=shape)
        )
        if len(basis.fields):
            design = np.concatenate([design, _field_columns(wire, part, basis.fields)])
        root = np.sqrt(part.weight) * base
        design = design * root
        data = residual * root
        matrix += design @ design.T
        right += design @ data
        power += float(data @ data)
        samples += int(np.count_nonzero(part.weight))
    return Normal(matrix, right, power, samples)
