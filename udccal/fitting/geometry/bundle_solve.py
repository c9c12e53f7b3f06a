"""Levenberg-Marquardt for a bundle: few intrinsics seen by all views, six numbers of a pose seen by one view only.

The normal equations are

    [ A    B ] [d intrinsics]     [g]        A: 9 x 9,  B_v: 9 x 6,  C_v: 6 x 6,
    [ B^T  C ] [d poses     ] = - [h],

with C block diagonal, so that the poses are eliminated view by view (Schur complement: Triggs et al., Bundle
Adjustment - A Modern Synthesis, 2000, section 6.1). Slopes come from automatic differentiation of the model itself.
One compiled function serves all orders of the distortion, all starts and all sizes padded alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udccal.fitting.engine.iteration_log import LOG
from udccal.fitting.geometry.bundle_normal import (
    INTRINSICS,
    BundleData,
    NormalEquations,
    damped_step,
    normal_equations,
    weighted_residuals,
    weighted_slopes,
)
from udccal.fitting.geometry.bundle_points import Blocks, Points, blocks
from udccal.numerics import in_float64

# Residuals of a robust solve count as Cauchy's: half at this many sigma. A plain solve has no such bend in reach.
CAUCHY_SIGMA = 2.5
_PLAIN = 1e7
# Converged: another step would lower chi2 by less than this part of one residual's share.
_LEFT_TO_GAIN = 1e-7
_MAX_ITERATIONS = 60
_MOST_DAMPING = 1e12


@dataclass(frozen=True)
class Prior:
    """Independent normal priors on the intrinsics; a precision (inverse variance) of 0 is none."""

    mean: Float[np.ndarray, "9"]
    precision: Float[np.ndarray, "9"]


NO_PRIOR = Prior(np.zeros(INTRINSICS), np.zeros(INTRINSICS))


@dataclass(frozen=True)
class Bundle:
    """Intrinsics (fx, fy, cx, cy, k1, k2, p1, p2, k3) and one pose per view: rotation vector, then translation."""

    intrinsics: Float[np.ndarray, "9"]
    poses: Float[np.ndarray, "views 6"]


@dataclass(frozen=True)
class Solved:
    """A minimum, and the normal equations there.

    ``cost`` is chi2 (Cauchy's in a robust solve) with the prior's share; ``gain`` what one more step would lower it.
    """

    bundle: Bundle
    cost: float
    iterations: int
    converged: bool
    common: Float[np.ndarray, "9 9"]
    mixed: Float[np.ndarray, "views 9 6"]
    own: Float[np.ndarray, "views 6 6"]


class _State(NamedTuple):
    intrinsics: Array
    poses: Array
    cost: Array
    normal: NormalEquations
    damping: Array
    iteration: Array
    done: Array
    trace: Array


@jax.jit
def _solve(intrinsics: Array, poses: Array, data: BundleData) -> _State:
    share = jnp.maximum(2 * (data.weight > 0).sum(), 1)

    def unfinished(state: _State) -> Array:
        return ~state.done & (state.iteration < _MAX_ITERATIONS)

    def step(state: _State) -> _State:
        lens, pose, fall = damped_step(state.normal, state.damping)
        moved, turned = state.intrinsics + lens, state.poses + pose
        cost, normal = normal_equations(moved, turned, data)
        better = (cost <= state.cost) & jnp.isfinite(fall)
        small = (fall <= _LEFT_TO_GAIN * state.cost / share) & (state.damping < 1e-3)
        # The quadratic model foretells the fall well: trust it more; else less.
        true_to_model = (state.cost - cost) > 0.5 * fall
        lower = jnp.where(true_to_model, state.damping / 10, state.damping)
        damping = jnp.where(better, jnp.maximum(lower, 1e-12), jnp.maximum(state.damping, 1e-9) * 8)
        now = state.iteration + 1

        def pick(new: Array, old: Array) -> Array:
            return jnp.where(better, new, old)

        return _State(
            pick(moved, state.intrinsics),
            pick(turned, state.poses),
            pick(cost, state.cost),
            jax.tree.map(pick, normal, state.normal),
            damping,
            now,
            small | (damping > _MOST_DAMPING),
            state.trace.at[now].set(pick(cost, state.cost)),
        )

    cost, normal = normal_equations(intrinsics, poses, data)
    trace = jnp.zeros(_MAX_ITERATIONS + 1).at[0].set(cost)
    first = _State(intrinsics, poses, cost, normal, jnp.asarray(1e-4), jnp.asarray(0), jnp.asarray(False), trace)
    return jax.lax.while_loop(unfinished, step, first)


_last_step = jax.jit(damped_step)


@in_float64
def solve(start: Bundle, points: Points, free: Bool[np.ndarray, "9"], prior: Prior, robust: bool = False) -> Solved:
    """The minimum of chi2 next to ``start``.

    Args:
        start: where to begin; intrinsics that are held stay at this.
        points: those in use take part, by their sigma.
        free: which of the intrinsics are fitted.
        prior: on the free intrinsics.
        robust: residuals beyond ``CAUCHY_SIGMA`` count for less and less, as a Cauchy distribution has them.
    """
    padded = blocks(points)
    count = len(points.names)
    poses = np.tile(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), (len(padded.board), 1))
    poses[:count] = start.poses
    state = _solve(start.intrinsics, poses, _data(padded, free, prior, CAUCHY_SIGMA if robust else _PLAIN))
    state = jax.tree.map(np.asarray, state)
    for iteration, cost in enumerate(state.trace[: int(state.iteration) + 1]):
        LOG.debug("bundle, %d of 5 distortions: iteration %d, chi2 %.9g", int(free[4:].sum()), iteration, cost)
    fall = float(_last_step(state.normal, 1e-12)[2])
    share = state.cost / max(2 * int(points.used.sum()), 1)
    return Solved(
        bundle=Bundle(state.intrinsics, state.poses[:count]),
        cost=float(state.cost),
        iterations=int(state.iteration),
        # A solver that stalls at the limit of its arithmetic passes; one that ran out of iterations does not.
        converged=bool(np.isfinite(state.cost) and fall < max(1e-3 * share, 1e-6)),
        common=state.normal.common,
        mixed=state.normal.mixed[:count],
        own=state.normal.own[:count],
    )


def _data(padded: Blocks, free: np.ndarray, prior: Prior, bend: float) -> BundleData:
    mask = np.asarray(free, dtype=np.float64)
    return BundleData(padded.board, padded.image, padded.weight, mask, prior.mean, prior.precision, np.float64(bend))


@jax.jit
def _linear(intrinsics: Array, poses: Array, data: BundleData) -> tuple[Array, Array]:
    return weighted_residuals(intrinsics, poses, data), weighted_slopes(intrinsics, poses, data)


@in_float64
def residuals_px(bundle: Bundle, points: Points) -> Float[np.ndarray, "points 2"]:
    """Projected minus seen, of all points."""
    return linearised(bundle, points)[0]


@in_float64
def linearised(
    bundle: Bundle, points: Points
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 15"]]:
    """Projected minus seen in px, and the slopes of that by intrinsics and own pose, of all points."""
    padded = blocks(points)
    poses = np.tile(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), (len(padded.board), 1))
    poses[: len(points.names)] = bundle.poses
    ones = np.zeros(padded.weight.shape)
    ones[padded.row, padded.column] = 1.0
    data = BundleData(padded.board, padded.image, ones, np.ones(INTRINSICS), np.zeros(9), np.zeros(9), np.float64(1.0))
    residuals, slopes = (np.asarray(part) for part in _linear(bundle.intrinsics, poses, data))
    return residuals[padded.row, padded.column], slopes[padded.row, padded.column]
