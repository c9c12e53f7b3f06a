"""Light that a fitted backscatter term predicts, and how sure it is: of white over the whole grid, of new pictures."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from udccal.fitting.backscatter_data import PanelShots, directions
from udccal.fitting.backscatter_likelihood import (
    Evidence,
    Profiled,
    evidence,
    light_ratios,
    profiled,
    shot_ratios,
    weights,
    weights_to_start,
)
from udccal.fitting.backscatter_vector import with_vector
from udccal.models.arrays import Arrayish
from udccal.models.backscatter import Backscatter, grid_positions, window_corners
from udccal.numerics import in_float64

_CHUNK = 1024


@dataclass(frozen=True)
class Light:
    """Predicted rates in e-/s at positions, by camera colour, and one sigma of each."""

    rate: Float[np.ndarray, "pictures 3 n"]
    sigma: Float[np.ndarray, "pictures 3 n"]


@dataclass(frozen=True)
class Knowledge:
    """What a fit knows: parameters in the solver's coordinates, their covariance, and what the model leaves out.

    ``share`` is one sigma of the error of ratios that the model leaves undescribed; ``kept`` tells which shots (white
    first) took part.
    """

    template: Backscatter
    x: Float[np.ndarray, "18"]
    cov: Float[np.ndarray, "18 18"]
    share: float
    kept: tuple[bool, ...]


@in_float64
def grid_rays(template: Backscatter, flat: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Rays of grid positions by their flat indices."""
    x, y = (np.asarray(axis) for axis in grid_positions(template.columns, template.rows, template.step))
    rows, columns = np.divmod(flat, len(x))
    return np.asarray(directions(template.geometry, np.stack([x[columns], y[rows]], axis=1)), dtype=np.float64)


@in_float64
def mask_of(known: Knowledge, shots: PanelShots) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
    """Light of white over the whole grid from all shots, which know it better than the white picture alone.

    Noise can bring it below zero where there is no light; light cannot be, so that it ends at zero.
    """
    count = shots.white.rate[0].size
    chunk = min(_CHUNK, count)
    mask = np.zeros((3, count))
    for first in range(0, count, chunk):
        # The last chunk reaches back into the one before: all have one shape and are compiled once.
        flat = np.arange(first, first + chunk) - max(first + chunk - count, 0)
        seen, corner = _seen_at(known, shots, flat)
        best, _, _ = _best(known, seen, corner)
        mask[:, flat] = best.mask
    return np.maximum(mask, 0.0).reshape(shots.white.rate.shape)


@in_float64
def predict_light(
    known: Knowledge,
    shots: PanelShots,
    pictures: UInt8[np.ndarray, "pictures crop_rows crop_columns 3"],
    flat: Int[np.ndarray, " n"],
) -> Light:
    """Light of new pictures (the part of them in the shots' crop) at grid positions given by flat indices.

    The error bar holds the parameters' covariance, the mask's noise at each position, how the two hang together, and
    the model's own error.
    """
    seen, corner = _seen_at(known, shots, flat)
    best, weight, _ = _best(known, seen, corner)
    new = pictures.astype(np.float64)
    rate, slope, ratio = _light_and_slope(known.template, known.x, seen, weight, corner, new)
    rate, slope, ratio = (np.asarray(part) for part in (rate, slope, ratio))
    variance = np.einsum("kicn,kl,licn->icn", slope, known.cov, slope)
    variance = variance + ratio**2 / np.maximum(best.information, 1e-30)
    return Light(rate, np.sqrt(variance + (known.share * best.mask) ** 2))


def _seen_at(known: Knowledge, shots: PanelShots, flat: Int[np.ndarray, " n"]) -> tuple[Evidence, np.ndarray]:
    rays = grid_rays(known.template, flat)
    seen = evidence(shots, rays, flat)
    kept = np.asarray(known.kept)[:, None, None]
    seen = eqx.tree_at(lambda s: s.usable, seen, np.asarray(seen.usable) & kept)
    return seen, np.asarray(_corners(known.template, known.x, rays))


def _best(
    known: Knowledge, seen: Evidence, corner: np.ndarray
) -> tuple[Profiled, Float[np.ndarray, "shots 3 n"], Float[np.ndarray, "shots 3 n"]]:
    """Mask at weights of the model, those weights, and the ratios."""
    weight = weights_to_start(seen)
    ratio = np.asarray(_ratios(known.template, known.x, seen, corner))
    # Once by weights of what was measured, then by those of the model.
    for _ in range(2):
        best = jax.tree.map(np.asarray, _profiled(ratio, seen, weight))
        weight = weights(seen, best.mask * ratio, best.mask, known.share, np.asarray(seen.usable))
    return jax.tree.map(np.asarray, _profiled(ratio, seen, weight)), weight, ratio


_profiled = jax.jit(profiled)


@eqx.filter_jit
def _ratios(
    template: Backscatter, x: Float[Arrayish, "18"], seen: Evidence, corner: Int[Arrayish, "n 2"]
) -> Float[Array, "shots 3 n"]:
    return shot_ratios(with_vector(template, jnp.asarray(x)), seen, corner)


@eqx.filter_jit
def _corners(template: Backscatter, x: Float[Arrayish, "18"], rays: Float[Arrayish, "n 3"]) -> Int[Array, "n 2"]:
    return window_corners(with_vector(template, jnp.asarray(x)), rays)


@eqx.filter_jit
def _light_and_slope(
    template: Backscatter,
    x: Float[Arrayish, "18"],
    seen: Evidence,
    weight: Float[Arrayish, "shots 3 n"],
    corner: Int[Arrayish, "n 2"],
    pictures: Float[Arrayish, "pictures crop_rows crop_columns 3"],
) -> tuple[Float[Array, "pictures 3 n"], Float[Array, "18 pictures 3 n"], Float[Array, "pictures 3 n"]]:
    """Rates of new pictures, their slopes by the parameters (the mask follows them), and their ratios to white."""

    def ratios_of(values: Array) -> tuple[Array, Array]:
        term = with_vector(template, values)
        new = light_ratios(term, seen, corner, pictures)
        return new, shot_ratios(term, seen, corner)

    (new, old), (new_slope, old_slope) = ratios_of(jnp.asarray(x)), jax.jacfwd(ratios_of)(jnp.asarray(x))
    best = profiled(old, seen, weight)
    # Of the best mask for an expected light of mask times ratio: what noise adds to it is of second order.
    expected = eqx.tree_at(lambda s: (s.light, s.dark), seen, (best.mask * old, jnp.zeros_like(best.dark)))

    def mask_at(ratio: Array) -> Array:
        return profiled(ratio, expected, weight).mask

    by_mask = jax.vmap(lambda way: jax.jvp(mask_at, (old,), (way,))[1])(jnp.moveaxis(old_slope, -1, 0))
    slope = best.mask * jnp.moveaxis(new_slope, -1, 0) + new * by_mask[:, None]
    return best.mask * new, slope, new
