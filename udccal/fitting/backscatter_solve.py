"""Where the footprints lie on the panel, and where a fit of the backscatter term may start."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udccal.fitting.backscatter_likelihood import Evidence, light_ratios, weights_to_start
from udccal.fitting.backscatter_vector import (
    TWO_PLANES,
    Prior,
    offset_reach_px,
    values_of,
    with_vector,
    without_crosstalk,
)
from udccal.models.arrays import Arrayish
from udccal.models.backscatter import Backscatter, footprints, window_corners
from udccal.numerics import in_float64
from udccal.rig import RigDescription

_SCAN_STEP_PX = 1.25
# Room that a window leaves for the footprint to move during a fit.
SLACK_PX = 0.7


@dataclass(frozen=True)
class Start:
    """Parameters to begin with, and how well they describe the pictures (a sum of squares, lower is better)."""

    x: Float[np.ndarray, "18"]
    cost: float


@in_float64
def corners_of(
    template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"]
) -> Int[np.ndarray, "n 2"]:
    """First panel pixel of the window of each position."""
    return np.asarray(_corners(template, x, rays)).astype(np.int64)


@in_float64
def window_for(template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"], slack: float) -> int:
    """Odd number of panel pixels across a window that holds both footprints at every position."""
    (near, shape), (far, far_shape), emitters = jax.tree.map(np.asarray, _extents(template, x, rays))
    extent = np.maximum(np.linalg.norm(shape, axis=2), np.linalg.norm(far_shape, axis=2)).max()
    apart = np.abs(far - near).max() / 2
    spread = np.abs(emitters - emitters.mean(axis=0)).max()
    return 2 * int(np.ceil(extent + apart + spread + 4 * float(values_of(x)[3]) + slack)) + 1


def with_room(template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"]) -> Backscatter:
    """The template with a window that holds the footprints and lets them move, never smaller than it was."""
    if window_for(template, x, rays, 0.0) <= template.window:
        return template
    return replace(template, window=window_for(template, x, rays, SLACK_PX))


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
def scan_offset(template: Backscatter, seen: Evidence, rig: RigDescription, prior: Prior) -> Start:
    """Panel offset at which a free mix of primaries explains the ratios best: where least squares may start."""
    best = Start(prior.mean, np.inf)
    across, down = (_SCAN_STEP_PX * np.ceil(reach / _SCAN_STEP_PX) for reach in offset_reach_px(rig))
    target = _ratios_seen(seen)
    for y in np.arange(-down, down + 1e-9, _SCAN_STEP_PX):
        for x in np.arange(-across, across + 1e-9, _SCAN_STEP_PX):
            vector = prior.mean.copy()
            vector[6:8] = x, y
            plain = without_crosstalk(TWO_PLANES).start(vector, prior)
            corner = corners_of(template, plain, np.asarray(seen.rays))
            primaries = np.asarray(_primaries(template, plain, seen, corner))
            cost = sum(_free_mix_cost(primaries, target, channel) for channel in range(3))
            if cost < best.cost:
                best = Start(vector, cost)
    return best


@eqx.filter_jit
def _primaries(
    template: Backscatter, x: Float[Arrayish, "18"], seen: Evidence, corner: Int[Arrayish, "n 2"]
) -> Float[Array, "pictures 3 n"]:
    return light_ratios(with_vector(template, jnp.asarray(x)), seen, corner, seen.shown)


@dataclass(frozen=True)
class _Target:
    """Light of pictures over that of white, and weights of it: enough to find a start."""

    ratio: Float[np.ndarray, "pictures 3 n"]
    weight: Float[np.ndarray, "pictures 3 n"]


def _ratios_seen(seen: Evidence) -> _Target:
    light = np.asarray(seen.light) - np.asarray(seen.exposure)[:, None, None] * np.asarray(seen.dark)
    weight = weights_to_start(seen)
    lit = light[0] * weight[0] > 1.0
    white = np.where(lit, light[0], 1.0)
    return _Target(np.where(lit, light[1:] / white, 0.0), np.where(lit, weight[1:] * white, 0.0))


def _free_mix_cost(primaries: Float[np.ndarray, "pictures 3 n"], target: _Target, channel: int) -> float:
    weight = target.weight[:, channel].ravel()
    design = np.moveaxis(primaries, 1, -1).reshape(-1, 3) * weight[:, None]
    wanted = target.ratio[:, channel].ravel() * weight
    solution = np.linalg.lstsq(design, wanted, rcond=None)[0]
    return float(((design @ solution - wanted) ** 2).sum())
