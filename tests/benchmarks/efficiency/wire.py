"""The wire fit at its limit: flats drawn from the model on a reduced sensor, map and shape against the bound.

Truths are drawn from the prior that the fit has, noise is shot noise and PRNU. The fit has the part of the pixels that
the default effort uses at full size; efficiency is of these, and "of all data" of all pixels.
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
from tests.scenes.information import fisher_information
from tests.scenes.wire import (
    COLUMNS,
    ELECTRONS,
    PAIRS,
    PRNU,
    ROWS,
    SITES,
    drawn_truth,
    fitted,
    geometry,
    map_at,
    map_sigma,
    noisy,
    places,
    shape_values,
    start,
)
from udccal.effort import FitEffort
from udccal.fitting.engine.gaussian import cramer_rao
from udccal.fitting.wire.data import odd_step
from udccal.fitting.wire.parameters import SHAPE_NAMES, WireRules, WireStart, shape_sigma, shape_vector, with_shape
from udccal.models.wire import Wire, wire_values
from udccal.numerics import in_float64
from udccal.result import FitResult
from udccal.rig import load_rig

_TRUTHS = 240
# Of the largest rig's pixels, which a fit of the default effort uses.
_CAMERA = load_rig("lg55-aca2040").camera
SHARE = FitEffort().wire_samples / (_CAMERA.rows * _CAMERA.columns)


def predict(
    x: Float[Array, " n"], truth: Wire, shape: Float[Array, "10"], pixels: Array, site: Array, prnu: Array
) -> tuple[Array, Array]:
    """Mean and variance of every pixel in electrons; ``x``: changes of shape and baseline, three site gains."""
    wire = _moved(truth, shape, x)
    gains = jnp.exp(jnp.append(x[-3:], -jnp.sum(x[-3:])))
    mean = ELECTRONS * jnp.asarray(SITES.ravel())[site] * gains[site] * wire_values(wire, pixels, ROWS, COLUMNS)
    return mean, mean + (prnu * mean) ** 2


def normalised(x: Float[Array, " n"], truth: Wire, shape: Float[Array, "10"], pixels: Array, grid: Array) -> Array:
    """The map at ``pixels``, its mean over ``grid`` 1."""
    wire = _moved(truth, shape, x)
    whole = wire_values(wire, jnp.concatenate([pixels, grid]), ROWS, COLUMNS)
    return whole[: len(pixels)] / jnp.mean(whole[len(pixels) :])


def _moved(truth: Wire, shape: Array, x: Array) -> Wire:
    baseline = jnp.asarray(truth.baseline).at[tuple(PAIRS.T)].add(x[10 : 10 + len(PAIRS)])
    return eqx.tree_at(lambda w: w.baseline, with_shape(truth, shape + x[:10]), baseline)


_map_slopes = jax.jit(jax.jacfwd(normalised))


def _grid(rows: int, columns: int) -> Float[np.ndarray, "n 2"]:
    down, across = ((np.arange(n) + 0.5) / n * size - 0.5 for n, size in ((rows, ROWS), (columns, COLUMNS)))
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


# Of the shape in the fit's units, and of the map.
Bounds = tuple[Float[np.ndarray, "10"], Float[np.ndarray, " places"]]


@in_float64
def bounds(truth: Wire, built: WireStart, step: int) -> Bounds:
    """Cramér–Rao bounds of every so manieth pixel, the prior's information included."""
    y, x = np.divmod(np.arange(0, ROWS * COLUMNS, step), COLUMNS)
    # As ``sample_pixels`` has it, which visits all CFA sites.
    if COLUMNS % step == 0:
        x = (x + y) % COLUMNS
    pixels, site = np.stack([x, y], axis=-1).astype(np.float64), 2 * (y % 2) + x % 2
    at = np.zeros(10 + len(PAIRS) + 3)
    information = np.diag(np.append(shape_sigma(built, WireRules()) ** -2.0, np.zeros(len(at) - 10)))
    for part in np.array_split(np.arange(len(pixels)), 4):
        information += fisher_information(
            predict, at, truth, shape_vector(truth), pixels[part], site[part], np.float64(PRNU)
        )
    unit = np.ones(10)
    unit[:3] = 180 / np.pi
    unit[3], unit[6] = float(truth.standoff_per_pitch), float(truth.footprint_per_pitch)
    slopes = np.asarray(_map_slopes(at, truth, shape_vector(truth), places(), _grid(48, 64)))
    return cramer_rao(information)[:10] * unit, cramer_rao(information, slopes)


@final
@dataclass(frozen=True)
class Errors:
    """Errors of one fit: shape and map, with their sigmas, and bounds of the pixels used and of all."""

    shape: Float[np.ndarray, "4 10"]
    places: Float[np.ndarray, "4 places"]


def errors(fit: FitResult[Wire], truth: Wire, used: Bounds, every: Bounds) -> Errors:
    """Estimate minus truth, sigma, bounds."""
    result = fit.or_raise()
    found = np.array([e.value for e in result.numbers])
    off = found - shape_values(truth)
    off[4:6] -= np.round(off[4:6])
    whole = map_at(truth, _grid(192, 256)).mean()
    error = map_at(result.term, places()) - map_at(truth, places()) / whole
    stated = np.array([e.sigma for e in result.numbers])
    shape, sigma = np.stack([off, stated, used[0], every[0]]), map_sigma(result, places())
    return Errors(shape, np.stack([error, sigma, used[1], every[1]]))


def trials(share: float) -> list[Trials]:
    """Shape and map, one fit of every truth."""
    found, samples = [], round(SHARE * ROWS * COLUMNS)
    for number in range(max(2, round(_TRUTHS * share))):
        built, lens = start(), geometry()
        truth = drawn_truth(number, built, lens)
        used, every = (bounds(truth, built, step) for step in (odd_step(ROWS * COLUMNS, samples), 1))
        fit = fitted(noisy(truth, 1000 * number), built, lens, samples=samples)
        found.append(errors(fit, truth, used, every))

    def trials_of(name: str, of: Float[np.ndarray, "realisations 4 places"]) -> Trials:
        return Trials(f"wire/{name}", of[:, 0], of[:, 1], of[:, 2], bound_of_all=of[:, 3])

    shape, whole = np.stack([f.shape for f in found]), np.stack([f.places for f in found])
    return [trials_of("map", whole), *(trials_of(name, shape[:, :, [i]]) for i, name in enumerate(SHAPE_NAMES))]
