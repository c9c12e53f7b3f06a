"""Least squares for the backscatter term: ratios of a picture's light to the white picture's, which cancel the mask."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udccal.fitting.backscatter_data import PanelShots
from udccal.fitting.solvers import Solution, least_squares
from udccal.models.arrays import Arrayish
from udccal.models.backscatter import (
    Backscatter,
    emitter_shares,
    footprints,
    mixed_colours,
    panel_light,
    window_corners,
)
from udccal.numerics import in_float64
from udccal.rig import RigDescription

NAMES = (
    "gamma", "distance_mm", "pupil_mm", "softness_px", "reflection", "reflection_mm", "offset_x_px", "offset_y_px",
    "red_x_px", "red_y_px", "blue_x_px", "blue_y_px", "mix_rg", "mix_rb", "mix_gr", "mix_gb", "mix_br", "mix_bg",
)  # fmt: skip
UNITS = ("1", "mm", "mm", "px", "1", "mm", *["px"] * 6, *["1"] * 6)
# Part of the white signal that the model is not trusted below: interpolation and binning over a block.
_MODEL_FLOOR = 1e-3
_OFF_DIAGONAL = (np.array([0, 0, 1, 1, 2, 2]), np.array([1, 2, 0, 2, 0, 1]))
_SOLVER_STEPS = 15
_SCAN_STEP_PX = 1.25
# Room that a window leaves for the footprint to move during a fit.
SLACK_PX = 0.7


@dataclass(frozen=True)
class Ratios:
    """Data of the fit at sampled positions: light of each picture over that of white, weights, and panel values.

    ``first`` is the (column, row) of the first panel pixel of ``shown``.
    """

    rays: Float[np.ndarray, "n 3"]
    ratio: Float[np.ndarray, "pictures 3 n"]
    weight: Float[np.ndarray, "pictures 3 n"]
    shown: Float[np.ndarray, "pictures crop_rows crop_columns 3"]
    first: Int[np.ndarray, "2"]


def ratios(shots: PanelShots, rays: Float[np.ndarray, "n 3"], flat: Int[np.ndarray, " n"]) -> Ratios:
    """Ratios to white with weights 1 / sigma; positions without white light have no weight."""
    white, white_variance = (a.reshape(3, -1)[:, flat] for a in (shots.white.rate, shots.white.variance))
    lit = white > 5 * np.sqrt(white_variance)
    safe = np.where(lit, white, 1.0)
    ratio, weight = [], []
    for seen in shots.seen:
        value = seen.rate.reshape(3, -1)[:, flat] / safe
        variance = (seen.variance.reshape(3, -1)[:, flat] + value**2 * white_variance) / safe**2
        ratio.append(np.where(lit, value, 0.0))
        weight.append(np.where(lit, 1 / np.sqrt(variance + _MODEL_FLOOR**2), 0.0))
    shown, first = shots.shown.astype(np.float64), np.array([shots.crop.column, shots.crop.row])
    return Ratios(rays, np.stack(ratio), np.stack(weight), shown, first)


def start_vector(rig: RigDescription, offset_px: Float[np.ndarray, "2"]) -> Float[np.ndarray, "18"]:
    """Nominal values, with a panel offset found by scanning."""
    panel = rig.panel
    depth = 2 * panel.glass_thickness_mm / panel.glass_index
    head = [panel.gamma.value, rig.mounting.standoff_mm.value, rig.pupil_mm, 0.15, 0.5, depth]
    return np.concatenate([head, offset_px, np.zeros(4), np.full(6, 0.1)])


def prior_sigma(rig: RigDescription) -> Float[np.ndarray, "18"]:
    """How far each value may be from ``start_vector``: the rig's tolerances, and what no data sheet says, wide."""
    panel, lens, mounting = rig.panel, rig.lens, rig.mounting
    pupil = rig.pupil_mm * (
        lens.focal_mm.tolerance / lens.focal_mm.value + lens.f_number.tolerance / lens.f_number.value + 0.02
    )
    depth = panel.glass_thickness_mm / panel.glass_index
    head = [panel.gamma.tolerance + 0.02, mounting.standoff_mm.tolerance + 0.1, pupil, 0.1, 1.0, depth]
    return np.concatenate([head, [2.0, 2.0], np.full(4, 0.3), np.full(6, 0.3)])


def with_vector(term: Backscatter, x: Float[Array, "18"]) -> Backscatter:
    """The term with the values of a parameter vector."""
    common = x[6:8]
    emitters = jnp.stack([common + x[8:10], common, common + x[10:12]])
    mix = jnp.eye(3, dtype=x.dtype).at[_OFF_DIAGONAL].set(x[12:18])
    return eqx.tree_at(
        lambda t: (
            t.gamma, t.distance_mm, t.pupil_mm, t.softness_px, t.reflection, t.reflection_mm, t.emitters_px, t.mix
        ),
        term,
        (x[0], x[1], x[2], x[3], x[4], x[5], emitters, mix / mix.sum(axis=1, keepdims=True)),
    )  # fmt: skip


def predict(
    term: Backscatter,
    rays: Float[Arrayish, "n 3"],
    corner: Int[Arrayish, "n 2"],
    shown: Float[Arrayish, "pictures crop_rows crop_columns 3"],
    first: Int[Arrayish, "2"],
) -> Float[Array, "pictures 3 n"]:
    """Ratio of each picture's light to white's along rays. ``first`` is the crop's first (column, row)."""
    corner, first = jnp.asarray(corner), jnp.asarray(first)
    crop_rows, crop_columns = jnp.shape(shown)[1:3]
    span = jnp.arange(term.window)
    columns = corner[:, 0, None, None] - first[0] + span[None, None, :]
    rows = corner[:, 1, None, None] - first[1] + span[None, :, None]
    inside = (columns >= 0) & (columns < crop_columns) & (rows >= 0) & (rows < crop_rows)
    flat = jnp.clip(rows, 0, crop_rows - 1) * crop_columns + jnp.clip(columns, 0, crop_columns - 1)
    places = flat.reshape(len(flat), -1)
    shares = emitter_shares(term, rays, corner) * inside.reshape(places.shape)[..., None]
    light = panel_light(term, shown).reshape(-1, crop_rows * crop_columns, 3)
    gathered = jnp.einsum("nwp,inwp->inp", shares, light[:, places])
    mixed = mixed_colours(term, gathered)
    white = mixed_colours(term, shares.sum(axis=1))
    return jnp.moveaxis(mixed / jnp.maximum(white, 1e-9), 1, 2)


def _residuals(
    x: Float[Array, "18"],
    template: Backscatter,
    corner: Int[Arrayish, "n 2"],
    data: tuple[Arrayish, Arrayish, Arrayish, Arrayish, Arrayish],
    prior: tuple[Arrayish, Arrayish],
) -> Float[Array, " m"]:
    rays, ratio, weight, shown, first = data
    model = predict(with_vector(template, x), rays, corner, shown, first)
    return jnp.concatenate([((model - ratio) * weight).ravel(), (x - prior[0]) * prior[1]])


def solve(
    template: Backscatter,
    data: Ratios,
    start: Float[np.ndarray, "18"],
    corner: Int[np.ndarray, "n 2"],
    prior: tuple[Float[np.ndarray, "18"], Float[np.ndarray, "18"]],
    free: Float[np.ndarray, "18"],
    used: Float[np.ndarray, " pictures"],
) -> Solution:
    """Fit the values whose ``free`` is 1 to the pictures whose ``used`` is 1; the others stay at ``start``.

    ``prior`` is (mean, sigma) of every value; ``corner`` the window of each position.
    """
    weight = data.weight * used[:, None, None]
    arrays = (data.rays, data.ratio, weight, data.shown, data.first)
    args = (template, corner, arrays, (prior[0], 1 / prior[1]))
    scale = np.where(free > 0, 0.1 * prior[1], 0.0)
    return least_squares(_residuals, start, scale, *args, max_iterations=_SOLVER_STEPS, tolerance=1e-7)


@in_float64
def corners_of(
    template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"]
) -> Int[np.ndarray, "n 2"]:
    """First panel pixel of the window of each position."""
    return np.asarray(_corners(template, x, rays)).astype(np.int64)


@in_float64
def errors(
    template: Backscatter, data: Ratios, x: Float[np.ndarray, "18"], corner: Int[np.ndarray, "n 2"]
) -> Float[np.ndarray, "pictures 3 n"]:
    """Predicted less measured ratio, 0 where a position has no weight."""
    model = _predict(template, x, data.rays, corner, data.shown, data.first)
    return np.where(data.weight > 0, np.asarray(model, dtype=np.float64) - data.ratio, 0.0)


@in_float64
def window_for(template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"], slack: float) -> int:
    """Odd number of panel pixels across a window that holds both footprints at every position."""
    (near, shape), (far, far_shape), emitters = jax.tree.map(np.asarray, _extents(template, x, rays))
    extent = np.maximum(np.linalg.norm(shape, axis=2), np.linalg.norm(far_shape, axis=2)).max()
    apart = np.abs(far - near).max() / 2
    spread = np.abs(emitters - emitters.mean(axis=0)).max()
    return 2 * int(np.ceil(extent + apart + spread + 4 * abs(float(x[3])) + slack)) + 1


@eqx.filter_jit
def _predict(
    template: Backscatter,
    x: Float[Arrayish, "18"],
    rays: Float[Arrayish, "n 3"],
    corner: Int[Arrayish, "n 2"],
    shown: Float[Arrayish, "pictures crop_rows crop_columns 3"],
    first: Int[Arrayish, "2"],
) -> Float[Array, "pictures 3 n"]:
    return predict(with_vector(template, jnp.asarray(x)), rays, corner, shown, first)


@eqx.filter_jit
def _corners(template: Backscatter, x: Float[Arrayish, "18"], rays: Float[Arrayish, "n 3"]) -> Int[Array, "n 2"]:
    return window_corners(with_vector(template, jnp.asarray(x)), rays)


@eqx.filter_jit
def _extents(
    template: Backscatter, x: Float[Arrayish, "18"], rays: Float[Arrayish, "n 3"]
) -> tuple[tuple[Array, Array], tuple[Array, Array], Array]:
    """The direct and the reflected footprints, and the emitters' places."""
    term = with_vector(template, jnp.asarray(x))
    far = term.distance_mm + term.reflection_mm
    return footprints(term, rays, term.distance_mm), footprints(term, rays, far), jnp.asarray(term.emitters_px)


@in_float64
def scan_offset(template: Backscatter, data: Ratios, rig: RigDescription) -> Float[np.ndarray, "2"]:
    """Panel offset at which a free mix of primaries explains the ratios best: where least squares may start."""
    best, offset = np.inf, np.zeros(2)
    across, down = _scan_reach_px(rig)
    for y in np.arange(-down, down + 1e-9, _SCAN_STEP_PX):
        for x in np.arange(-across, across + 1e-9, _SCAN_STEP_PX):
            vector = start_vector(rig, np.array([x, y]))
            vector[12:] = 0.0
            corner = corners_of(template, vector, data.rays)
            primaries = np.asarray(_predict(template, vector, data.rays, corner, data.shown, data.first))
            cost = sum(_free_mix_cost(primaries, data, channel) for channel in range(3))
            if cost < best:
                best, offset = cost, np.array([x, y])
    return offset


def _scan_reach_px(rig: RigDescription) -> tuple[float, float]:
    """How far the pupil may be from its nominal panel pixel: the mounting's tolerance, and pitches that add up."""
    mounting, pitch = rig.mounting, rig.panel.pitch_mm
    stretch = pitch.tolerance / pitch.value
    reaches = [place.tolerance + place.value * stretch for place in (mounting.panel_x_px, mounting.panel_y_px)]
    across, down = (_SCAN_STEP_PX * np.ceil(reach / _SCAN_STEP_PX) for reach in reaches)
    return float(across), float(down)


def _free_mix_cost(primaries: Float[np.ndarray, "pictures 3 n"], data: Ratios, channel: int) -> float:
    weight = data.weight[:, channel].ravel()
    design = np.moveaxis(primaries, 1, -1).reshape(-1, 3) * weight[:, None]
    target = data.ratio[:, channel].ravel() * weight
    solution = np.linalg.lstsq(design, target, rcond=None)[0]
    return float(((design @ solution - target) ** 2).sum())
