"""The wire fit at its limit: flats drawn from the model on a reduced sensor, map and shape against the bound.

Truths are drawn from the prior that the fit has, noise is shot noise and PRNU, and all pixels are used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tests.benchmarks.efficiency.trials import Trials
from udccal.fitting.engine.information import cramer_rao, fisher_information
from udccal.fitting.wire import WireData, WireRules, WireStart, fit_wire
from udccal.fitting.wire.parameters import (
    SHAPE_NAMES,
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
_TRUTHS, _NOISES = 10, 12
_DEGREE = 4
_PLACES = 50
_PAIRS = np.array([(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)])


def start() -> WireStart:
    """A rig of few harmonics: fits of it are quick."""
    return WireStart(
        standoff_per_pitch=12.0,
        standoff_tolerance=0.03,
        pupil_per_pitch=6.0,
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
        focal=np.array([150.0, 150.0]),
        centre=np.array([79.0, 60.5]),
        distortion=np.array([-0.05, 0.01, 0.0, 0.0, 0.0]),
        rotation=np.array([-np.deg2rad(tilt_deg), 0.01, 0.02]),
        pupil=np.array([60.0, 30.0, -7.5]),
    )


@final
@dataclass(frozen=True)
class Flat:
    """A truth of the model's own kind, and one noisy average of flats of it."""

    truth: Wire
    signal: Float[np.ndarray, "rows columns"]
    variance: Float[np.ndarray, "rows columns"]


@in_float64
def drawn_truth(seed: int, built: WireStart, lens: Geometry, modulated: bool = True) -> Wire:
    """A wire drawn from the fit's prior, with shading."""
    rng = np.random.default_rng([seed, 1])
    harmonics = possible_harmonics(built).orders
    wire = ideal_wire(lens, built, harmonics if modulated else harmonics[:0])
    steps = shape_sigma(built, WireRules()) * np.clip(rng.standard_normal(10), -2.5, 2.5)
    steps[4:6] = rng.uniform(-0.5, 0.5, 2)
    # Beyond a degree the geometry fit would be to blame.
    steps[:3] *= 0.2
    if not modulated:
        # Nor does an absent panel narrow with obliquity.
        steps[9] = -built.depth_per_pitch
    baseline = np.zeros_like(np.asarray(wire.baseline))
    baseline[tuple(_PAIRS.T)] = 0.01 * rng.standard_normal(len(_PAIRS))
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


def fitted(flat: Flat, built: WireStart, lens: Geometry, prnu: float = PRNU, clip: float = np.inf) -> FitResult[Wire]:
    """The fit with all pixels."""
    data = WireData(flat.signal, flat.variance, lens, built, prnu, clip)
    return fit_wire(data, WireRules(samples=flat.signal.size))


def map_sigma(result: FitResult[Wire], pixels: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, " places"]:
    """Stated sigma of the map at pixels."""
    return result.sigma_of(lambda wire: map_at(wire, pixels))


def predict(x: Float[Array, " n"], truth: Wire, pixels: Array, site: Array, prnu: Array) -> tuple[Array, Array]:
    """Mean and variance of every pixel in electrons; ``x``: shape, baseline, three site gains."""
    wire = _moved(truth, x)
    gains = jnp.exp(jnp.append(x[-3:], -jnp.sum(x[-3:])))
    mean = ELECTRONS * jnp.asarray(SITES.ravel())[site] * gains[site] * wire_values(wire, pixels, ROWS, COLUMNS)
    return mean, mean + (prnu * mean) ** 2


def normalised(x: Float[Array, " n"], truth: Wire, pixels: Array, grid: Array) -> Array:
    """The map at ``pixels``, its mean over ``grid`` 1."""
    wire = _moved(truth, x)
    whole = wire_values(wire, jnp.concatenate([pixels, grid]), ROWS, COLUMNS)
    return whole[: len(pixels)] / jnp.mean(whole[len(pixels) :])


def _moved(truth: Wire, x: Array) -> Wire:
    baseline = jnp.asarray(truth.baseline).at[tuple(_PAIRS.T)].add(x[10 : 10 + len(_PAIRS)])
    return eqx.tree_at(lambda w: w.baseline, with_shape(truth, shape_vector(truth) + x[:10]), baseline)


_map_slopes = jax.jit(jax.jacfwd(normalised))


def _grid(rows: int, columns: int) -> Float[np.ndarray, "n 2"]:
    down, across = ((np.arange(n) + 0.5) / n * size - 0.5 for n, size in ((rows, ROWS), (columns, COLUMNS)))
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


def places() -> Float[np.ndarray, "places 2"]:
    """Where the map is looked at."""
    spread = np.mod(0.5 + np.arange(1, _PLACES + 1)[:, None] * np.array([0.7548776662, 0.5698402910]), 1.0)
    return spread * np.array([COLUMNS - 1.0, ROWS - 1.0])


@in_float64
def bounds(truth: Wire, built: WireStart) -> tuple[Float[np.ndarray, "10"], Float[np.ndarray, " places"]]:
    """Cramér–Rao bounds, the prior's information included: of the shape in the fit's units, and of the map."""
    y, x = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    pixels, site = np.stack([x, y], axis=-1).astype(np.float64), 2 * (y % 2) + x % 2
    at = np.zeros(10 + len(_PAIRS) + 3)
    information = np.diag(np.append(shape_sigma(built, WireRules()) ** -2.0, np.zeros(len(at) - 10)))
    for part in np.array_split(np.arange(len(pixels)), 4):
        information += fisher_information(predict, at, truth, pixels[part], site[part], np.float64(PRNU))
    unit = np.ones(10)
    unit[:3] = 180 / np.pi
    unit[3], unit[6] = float(truth.standoff_per_pitch), float(truth.pupil_per_pitch)
    slopes = np.asarray(_map_slopes(at, truth, places(), _grid(48, 64)))
    return cramer_rao(information)[:10] * unit, cramer_rao(information, slopes)


def shape_values(truth: Wire) -> Float[np.ndarray, "10"]:
    """The shape in the order and units of the estimates."""
    shape = (truth.standoff_per_pitch, *np.mod(truth.offset, 1.0), truth.pupil_per_pitch)
    return np.array([*np.rad2deg(truth.rotation), *shape, truth.row_open, truth.column_open, truth.depth_per_pitch])


@in_float64
def map_at(wire: Wire, pixels: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, " places"]:
    """The map at pixels."""
    return np.asarray(_values(wire, pixels, ROWS, COLUMNS))


_values = jax.jit(wire_values, static_argnums=(2, 3))


@final
@dataclass(frozen=True)
class Errors:
    """Of one fit: shape and map, their stated sigmas and their bounds."""

    shape: Float[np.ndarray, "3 10"]
    places: Float[np.ndarray, "3 places"]


def errors(
    fit: FitResult[Wire], truth: Wire, bound: tuple[Float[np.ndarray, "10"], Float[np.ndarray, " places"]]
) -> Errors:
    """Estimate minus truth, stated sigma, bound."""
    result = fit.or_raise()
    found = np.array([e.value for e in result.estimates])
    off = found - shape_values(truth)
    off[4:6] -= np.round(off[4:6])
    whole = map_at(truth, _grid(192, 256)).mean()
    error = map_at(result.term, places()) - map_at(truth, places()) / whole
    stated = np.array([e.sigma for e in result.estimates])
    return Errors(np.stack([off, stated, bound[0]]), np.stack([error, map_sigma(result, places()), bound[1]]))


def trials(share: float) -> list[Trials]:
    """Shape and map over truths and noises."""
    found = []
    for number in range(max(2, round(_TRUTHS * share))):
        built, lens = start(), geometry()
        truth = drawn_truth(number, built, lens)
        bound = bounds(truth, built)
        for noise in range(_NOISES):
            flat = noisy(truth, 1000 * number + noise)
            found.append(errors(fitted(flat, built, lens), truth, bound))
    shape, whole = np.stack([f.shape for f in found]), np.stack([f.places for f in found])
    made = [
        Trials(f"wire/{name}", *(shape[:, part, i : i + 1] for part in range(3))) for i, name in enumerate(SHAPE_NAMES)
    ]
    return [Trials("wire/map", *(whole[:, part] for part in range(3))), *made]
