"""Light that a fitted backscatter term predicts, and how sure it is: of white over the whole grid, of new pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from udccal.fitting.backscatter.data import PanelShots, directions
from udccal.fitting.backscatter.evidence import Evidence, Pictures, evidence, pictures_of, weights, weights_to_start
from udccal.fitting.backscatter.profile import (
    Profiled,
    mask_slopes,
    predicted_variance,
    profiled,
    with_still_white,
    with_white,
)
from udccal.fitting.backscatter.ratios import Windows, ratios, ratios_and_slopes, window_logs, windows_at
from udccal.fitting.backscatter.solve import corners_of
from udccal.models.backscatter import Backscatter, grid_positions
from udccal.numerics import in_float64

# Grid positions that are held in memory at a time.
_CHUNK = 4096


@dataclass(frozen=True)
class Light:
    """Predicted rates in e-/s at positions, by camera colour, and one sigma of each."""

    rate: Float[np.ndarray, "pictures 3 n"]
    sigma: Float[np.ndarray, "pictures 3 n"]


@dataclass(frozen=True)
class Other:
    """A candidate that was not chosen and may be right: its parameters, their covariance and its probability."""

    x: Float[np.ndarray, "18"]
    cov: Float[np.ndarray, "18 18"]
    probability: float


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
    others: tuple[Other, ...] = ()


@in_float64
def grid_rays(template: Backscatter, flat: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Rays of grid positions by their flat indices."""
    x, y = (np.asarray(axis) for axis in grid_positions(template.columns, template.rows, template.step))
    rows, columns = np.divmod(flat, len(x))
    return directions(template.geometry, np.stack([x[columns], y[rows]], axis=1))


def mask_of(known: Knowledge, shots: PanelShots) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
    """Light of white over the whole grid from all shots, which know it better than the white picture alone.

    Noise can bring it below zero where there is no light; light cannot be, so that it ends at zero.
    """
    count, shown = shots.white.rate[0].size, pictures_of(shots.shown, shots.crop)
    mask = np.zeros((3, count))
    for first in range(0, count, _CHUNK):
        flat = np.arange(first, min(first + _CHUNK, count))
        seen, at = _seen_at(known, shots, flat, shown)
        mask[:, flat] = _best(known, seen, with_white(ratios(known.template, known.x, at, shown)))[0].mask
    return np.maximum(mask, 0.0).reshape(shots.white.rate.shape)


def predict_light(
    known: Knowledge,
    shots: PanelShots,
    pictures: UInt8[np.ndarray, "pictures crop_rows crop_columns 3"],
    flat: Int[np.ndarray, " n"],
) -> Light:
    """Light of new pictures (the part of them in the shots' crop) at grid positions given by flat indices.

    The error bar holds the parameters' covariance, the mask's noise at each position, how the two hang together, and
    the model's own error; where several orders are possible, also by how much their predictions differ (Hoeting et al.,
    Statistical Science 14, 1999).
    """
    light = _predicted(known, shots, pictures, flat)
    variance = (1 - sum(one.probability for one in known.others)) * light.sigma**2
    for one in known.others:
        other = _predicted(replace(known, x=one.x, cov=one.cov), shots, pictures, flat)
        variance += one.probability * (other.sigma**2 + (other.rate - light.rate) ** 2)
    return Light(light.rate, np.sqrt(variance))


def _predicted(
    known: Knowledge,
    shots: PanelShots,
    pictures: UInt8[np.ndarray, "pictures crop_rows crop_columns 3"],
    flat: Int[np.ndarray, " n"],
) -> Light:
    """By one order alone."""
    # Both at once: the footprints are the same, and so is what is compiled.
    every = pictures_of(np.concatenate([shots.shown, pictures]), shots.crop)
    seen, at = _seen_at(known, shots, flat, every)
    ratio, slope = ratios_and_slopes(known.template, known.x, at, window_logs(at, every))
    new, new_slope = ratio[len(shots.shown) :], slope[:, len(shots.shown) :]
    old = with_white(ratio[: len(shots.shown)])
    old_slope = with_still_white(slope[:, : len(shots.shown)])
    best, weight = _best(known, seen, old)
    by_mask = mask_slopes(old, old_slope, best, seen, weight)
    variance = predicted_variance(new, new_slope, best, by_mask, known.cov)
    return Light(best.mask * new, np.sqrt(variance + (known.share * best.mask) ** 2))


def _seen_at(
    known: Knowledge, shots: PanelShots, flat: Int[np.ndarray, " n"], shown: Pictures
) -> tuple[Evidence, Windows]:
    rays = grid_rays(known.template, flat)
    seen = evidence(shots, rays, flat, shown)
    seen = replace(seen, usable=seen.usable & np.asarray(known.kept)[:, None, None])
    return seen, windows_at(known.template.window, rays, corners_of(known.template, known.x, rays), shown)


def _best(
    known: Knowledge, seen: Evidence, ratio: Float[np.ndarray, "shots 3 n"]
) -> tuple[Profiled, Float[np.ndarray, "shots 3 n"]]:
    """Mask at weights of the model, and those weights."""
    weight = weights_to_start(seen)
    # Once by weights of what was measured, then by those of the model.
    for _ in range(2):
        best = profiled(ratio, seen, weight)
        weight = weights(seen, best.mask * ratio, best.mask, known.share, seen.usable)
    return profiled(ratio, seen, weight), weight
