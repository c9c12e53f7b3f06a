"""Flats of wires drawn from the model, with noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from udccal.fitting.wire.data import WireData
from udccal.fitting.wire.fit import fit_wire
from udccal.fitting.wire.parameters import (
    WireRules,
    WireStart,
    ideal_wire,
    possible_harmonics,
    shape_sigma,
    shape_vector,
    with_shape,
)
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire, wire_map, wire_values
from udccal.numerics import in_float64
from udccal.result import FitResult

ROWS, COLUMNS = 120, 160


PRNU = 0.004


# Of the brightest CFA site's mean, in electrons of the average of all frames.
ELECTRONS = 1.2e5


SITES = np.array([[0.7, 1.0], [1.0, 0.6]])


_DEGREE = 4


_PLACES = 50


PAIRS = np.array([(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)])


def start() -> WireStart:
    """A rig of few harmonics: fits of it are quick."""
    return WireStart(
        standoff_per_pitch=12.0,
        standoff_tolerance=0.03,
        footprint_per_pitch=6.0,
        pupil_tolerance=0.04,
        row_open=0.4,
        row_tolerance=0.02,
        column_open=0.985,
        column_tolerance=0.002,
        depth_per_pitch=0.05,
        depth_tolerance=0.01,
    )


def geometry(tilt_deg: float = 17.0) -> Geometry:
    """A wide lens on the reduced sensor."""
    return Geometry(
        focal_px=np.array([150.0, 150.0]),
        principal_point_px=np.array([79.0, 60.5]),
        distortion=np.array([-0.05, 0.01, 0.0, 0.0, 0.0]),
        rotation_rad=np.array([-np.deg2rad(tilt_deg), 0.01, 0.02]),
        pupil_mm=np.array([60.0, 30.0, -7.5]),
    )


@final
@dataclass(frozen=True)
class Flat:
    """A truth of the model's own kind, and one noisy average of flats of it."""

    truth: Wire
    signal: Float[np.ndarray, "rows columns"]
    variance: Float[np.ndarray, "rows columns"]


@in_float64
def drawn_truth(
    seed: int,
    built: WireStart,
    lens: Geometry,
    modulated: bool = True,
    sharpness: float = 1.0,
    highest: float = np.inf,
) -> Wire:
    """A wire drawn from the fit's prior, with shading.

    ``sharpness`` below 1 gives the openings' edges a blur; smooth openings have harmonics up to the ``highest`` alone.
    """
    rng = np.random.default_rng([seed, 1])
    harmonics = possible_harmonics(built).orders
    harmonics = harmonics[np.abs(harmonics).sum(axis=1) <= highest]
    wire = ideal_wire(lens, built, harmonics if modulated else harmonics[:0])
    fields = np.array(wire.fields)
    fields[:, 0, 0, 0] = sharpness ** np.maximum((np.asarray(wire.harmonics) ** 2).sum(axis=1) - 1, 0)
    wire = eqx.tree_at(lambda w: w.fields, wire, fields)
    steps = shape_sigma(built, WireRules()) * np.clip(rng.standard_normal(10), -2.5, 2.5)
    steps[4:6] = rng.uniform(-0.5, 0.5, 2)
    # Beyond a degree the geometry fit would be to blame.
    steps[:3] *= 0.2
    if not modulated:
        # Nor does an absent panel narrow with obliquity.
        steps[9] = -built.depth_per_pitch
    baseline = np.zeros_like(np.asarray(wire.baseline))
    baseline[tuple(PAIRS.T)] = 0.01 * rng.standard_normal(len(PAIRS))
    baseline[2, 0] -= 0.08
    baseline[0, 2] -= 0.1
    moved = eqx.tree_at(lambda w: w.baseline, with_shape(wire, shape_vector(wire) + steps), baseline)
    # The map's mean is 1.
    baseline[0, 0] -= np.log(float(np.mean(np.asarray(wire_map(moved, ROWS, COLUMNS)))))
    moved = eqx.tree_at(lambda w: w.baseline, moved, baseline)
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), moved)


@in_float64
def true_map(truth: Wire, rows: int = ROWS, columns: int = COLUMNS) -> Float[np.ndarray, "rows columns"]:
    """Its map, mean 1."""
    found = np.asarray(wire_map(truth, rows, columns), dtype=np.float64)
    return np.asarray(found / found.mean())


def noisy(truth: Wire, seed: int, electrons: float = ELECTRONS, prnu: float = PRNU) -> Flat:
    """Poisson counts of pixels that differ a little."""
    rng = np.random.default_rng([seed, 2])
    whole = true_map(truth)
    level = electrons * whole * np.tile(SITES, (ROWS // 2, COLUMNS // 2))
    signal = rng.poisson(level * (1 + prnu * rng.standard_normal(level.shape))).astype(np.float64)
    return Flat(truth, signal, level)


def fitted(
    flat: Flat,
    built: WireStart,
    lens: Geometry,
    prnu: float = PRNU,
    clip: float = np.inf,
    samples: int = ROWS * COLUMNS,
) -> FitResult[Wire]:
    """The fit with so many pixels, by default with all."""
    data = WireData(flat.signal, flat.variance, lens, built, prnu, clip)
    return fit_wire(data, WireRules(samples=samples))


def map_sigma(result: FitResult[Wire], pixels: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, " places"]:
    """Stated sigma of the map at pixels."""
    return result.sigma_of(lambda wire: map_at(wire, pixels))


def places() -> Float[np.ndarray, "places 2"]:
    """Where the map is looked at."""
    spread = np.mod(0.5 + np.arange(1, _PLACES + 1)[:, None] * np.array([0.7548776662, 0.5698402910]), 1.0)
    return spread * np.array([COLUMNS - 1.0, ROWS - 1.0])


def shape_values(truth: Wire) -> Float[np.ndarray, "10"]:
    """The shape in the order and units of the estimates."""
    shape = (truth.standoff_per_pitch, *np.mod(truth.offset_periods, 1.0), truth.footprint_per_pitch)
    return np.array([*np.rad2deg(truth.rotation_rad), *shape, truth.row_open, truth.column_open, truth.depth_per_pitch])


@in_float64
def map_at(wire: Wire, pixels: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, " places"]:
    """The map at pixels."""
    return np.asarray(_values(wire, pixels, ROWS, COLUMNS))


_values = jax.jit(wire_values, static_argnums=(2, 3))


SEED = 3


def constant(value: float) -> FitResult[Wire]:
    """The fit of a flat that is the same everywhere."""
    signal = np.full((ROWS, COLUMNS), value)
    flat = Flat(drawn_truth(SEED, start(), geometry()), signal, np.full(signal.shape, max(value, 1.0)))
    return fitted(flat, start(), geometry())
