"""Where the footprints lie on the panel, and where a fit of the backscatter term may start."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udccal.fitting.backscatter.blocks import in_blocks
from udccal.fitting.backscatter.evidence import Evidence, weights_to_start
from udccal.fitting.backscatter.ratios import mixed_ratios, primary_light, shares_at, windows_at
from udccal.fitting.backscatter.vector import (
    EMITTERS,
    OFFSET,
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

# Room that a window leaves for the footprint to move during a fit.
SLACK_PX = 0.7
_MOST_WIDER = 3


@dataclass(frozen=True)
class Start:
    """Parameters to begin with, and how well they describe the pictures (a sum of squares, lower is better)."""

    x: Float[np.ndarray, "18"]
    cost: float


def corners_of(
    template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"]
) -> Int[np.ndarray, "n 2"]:
    """First panel pixel of the window of each position."""
    return _extents(template, x, rays).corner


def window_for(template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"], slack: float) -> int:
    """Odd number of panel pixels across a window that holds both footprints at every position."""
    found = _extents(template, x, rays)
    emitters = np.insert(x[EMITTERS].reshape(2, 2), 1, 0.0, axis=0)
    spread = np.abs(emitters - emitters.mean(axis=0)).max()
    return 2 * int(np.ceil(found.reach_px.max() + spread + 4 * float(values_of(x)[3]) + slack)) + 1


def with_room(template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"]) -> Backscatter:
    """The template with a window that holds the footprints and lets them move, never smaller than it was.

    It stays where it would have to be more than three times as wide: such a fit has gone astray.
    """
    if not template.window < window_for(template, x, rays, 0.0) <= _MOST_WIDER * template.window:
        return template
    return replace(template, window=window_for(template, x, rays, SLACK_PX))


@dataclass(frozen=True)
class _Extents:
    """Per position: the window's first panel pixel, and how far the footprints reach from its middle."""

    corner: Int[np.ndarray, "n 2"]
    reach_px: Float[np.ndarray, " n"]


@in_float64
def _extents(template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"]) -> _Extents:
    # The corner is worked out for a window of one pixel: windows of any size then share one compilation.
    single = replace(template, window=1)
    middle, reach = in_blocks(lambda part: _middle_and_reach(single, x, part), rays)
    return _Extents((middle - (template.window - 1) // 2).astype(np.int64), reach)


@jax.jit
def _middle_and_reach(
    template: Backscatter, x: Float[Arrayish, "18"], rays: Float[Arrayish, "b 3"]
) -> tuple[Int[Array, "b 2"], Float[Array, " b"]]:
    term = with_vector(template, jnp.asarray(x))
    near, shape = footprints(term, rays, term.distance_mm)
    far, far_shape = footprints(term, rays, term.distance_mm + term.reflection_mm)
    extent = jnp.maximum(jnp.linalg.norm(shape, axis=2), jnp.linalg.norm(far_shape, axis=2)).max(axis=1)
    return window_corners(term, rays), extent + jnp.abs(far - near).max(axis=1) / 2


@in_float64
def scan_offset(template: Backscatter, seen: Evidence, rig: RigDescription, prior: Prior) -> Start:
    """Panel offset at which a free mix of primaries explains the ratios best: where least squares may start.

    Offsets are whole panel pixels: a window that moves with them sees the same shares of its emitters.
    """
    across, down = (int(np.ceil(reach)) for reach in offset_reach_px(rig))
    target = _ratios_seen(seen)
    plain = without_crosstalk(TWO_PLANES).start(prior.mean, prior)
    corner = corners_of(template, plain, seen.rays)
    shares = shares_at(template, plain, seen.rays, corner)
    best = Start(prior.mean, np.inf)
    for y in range(-down, down + 1):
        for x in range(-across, across + 1):
            moved = windows_at(template.window, seen.rays, corner - np.array([x, y]), seen.shown)
            light, white = primary_light(shares, float(plain[0]), moved, seen.shown)
            primaries = mixed_ratios(light, white, np.eye(3))
            cost = sum(_free_mix_cost(primaries, target, channel) for channel in range(3))
            if cost < best.cost:
                vector = prior.mean.copy()
                vector[OFFSET] = x, y
                best = Start(vector, cost)
    return best


@dataclass(frozen=True)
class _Target:
    """Light of pictures over that of white, and weights of it: enough to find a start."""

    ratio: Float[np.ndarray, "pictures 3 n"]
    weight: Float[np.ndarray, "pictures 3 n"]


def _ratios_seen(seen: Evidence) -> _Target:
    light = seen.light - seen.exposure[:, None, None] * seen.dark
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
