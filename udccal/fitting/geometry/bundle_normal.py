"""Normal equations of a bundle by blocks, and one damped step: what is compiled of the solver."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish
from udccal.models.geometry import Geometry, project, rotation_matrix

INTRINSICS = 9


class BundleData(NamedTuple):
    """Points by view, padded, with 1 / sigma of each (0: not used); which intrinsics are free (1) and their prior.

    ``bend``: where residuals begin to count as Cauchy's, in sigma.
    """

    board: Arrayish
    image: Arrayish
    weight: Arrayish
    free: Arrayish
    prior_mean: Arrayish
    prior_precision: Arrayish
    bend: Arrayish


class NormalEquations(NamedTuple):
    """Blocks: intrinsics (9), intrinsics by pose (views 9 6), poses (views 6 6), and both gradients."""

    common: Array
    mixed: Array
    own: Array
    common_slope: Array
    own_slope: Array


def seen(
    intrinsics: Float[Array, "9"], pose: Float[Array, "6"], board: Float[Array, "points 3"]
) -> Float[Array, "points 2"]:
    """Where the points of one board appear, in px."""
    camera = Geometry(intrinsics[:2], intrinsics[2:4], intrinsics[4:9], jnp.zeros(3), jnp.zeros(3))
    return project(camera, board @ rotation_matrix(pose[:3]).T + pose[3:])


def weighted_residuals(intrinsics: Array, poses: Array, data: BundleData) -> Float[Array, "views points 2"]:
    """Projected minus seen in sigma."""
    where = jax.vmap(seen, in_axes=(None, 0, 0))(intrinsics, poses, data.board)
    # A padded view has weight zero everywhere; where it projects to must not matter, not even as infinity.
    return jnp.where(data.weight[..., None] > 0, (where - data.image) * data.weight[..., None], 0.0)


def weighted_slopes(intrinsics: Array, poses: Array, data: BundleData) -> Float[Array, "views points 2 15"]:
    """Of ``weighted_residuals``, by intrinsics (those held: 0) and own pose."""

    def one(pose: Array, board: Array) -> Array:
        def at(x: Array) -> Array:
            return seen(x[:INTRINSICS], x[INTRINSICS:], board)

        return jax.jacfwd(at)(jnp.concatenate([intrinsics, pose]))

    slopes = jax.vmap(one)(poses, data.board)
    mask = jnp.concatenate([data.free, jnp.ones(6)])
    return jnp.where(data.weight[..., None, None] > 0, slopes * data.weight[..., None, None], 0.0) * mask


def _cost(residuals: Array, intrinsics: Array, data: BundleData) -> Array:
    square = (residuals**2).sum(axis=-1)
    robust = data.bend**2 * jnp.log1p(square / data.bend**2)
    off = (intrinsics - data.prior_mean) ** 2 * data.prior_precision * data.free
    total = robust.sum() + off.sum()
    return jnp.where(jnp.isfinite(total), total, jnp.inf)


def normal_equations(intrinsics: Array, poses: Array, data: BundleData) -> tuple[Array, NormalEquations]:
    """Cost and normal equations at a point."""
    residuals = weighted_residuals(intrinsics, poses, data)
    slopes = weighted_slopes(intrinsics, poses, data)
    root = 1 / jnp.sqrt(1 + (residuals**2).sum(axis=-1, keepdims=True) / data.bend**2)
    views = len(poses)
    tall = (slopes * root[..., None]).reshape(views, -1, INTRINSICS + 6)
    right = (residuals * root).reshape(views, -1)
    blocks_ = jnp.einsum("vmi,vmj->vij", tall, tall)
    slope = jnp.einsum("vmi,vm->vi", tall, right)
    held, precision = 1 - data.free, data.prior_precision * data.free
    common = blocks_[:, :INTRINSICS, :INTRINSICS].sum(axis=0) + jnp.diag(precision + held)
    common_slope = slope[:, :INTRINSICS].sum(axis=0) + precision * (intrinsics - data.prior_mean)
    own = blocks_[:, INTRINSICS:, INTRINSICS:]
    # A view without points, there to fill the size, keeps its pose.
    own = own + jnp.where(jnp.trace(own, axis1=1, axis2=2) > 0, 0.0, 1.0)[:, None, None] * jnp.eye(6)
    parts = NormalEquations(common, blocks_[:, :INTRINSICS, INTRINSICS:], own, common_slope, slope[:, INTRINSICS:])
    return _cost(residuals, intrinsics, data), parts


def damped_step(normal: NormalEquations, damping: Array) -> tuple[Array, Array, Array]:
    """Steps of intrinsics and poses, and how much the quadratic model of chi2 falls."""
    # In units of their own slopes: focal lengths in px and distortions of 1e-3 are then alike.
    unit = 1 / jnp.sqrt(jnp.diagonal(normal.common) + 1e-300)
    own_unit = 1 / jnp.sqrt(jnp.diagonal(normal.own, axis1=1, axis2=2) + 1e-300)
    common = normal.common * unit[:, None] * unit + damping * jnp.eye(INTRINSICS)
    own = normal.own * own_unit[:, :, None] * own_unit[:, None, :] + damping * jnp.eye(6)
    mixed = normal.mixed * unit[:, None] * own_unit[:, None, :]
    slope, own_slope = normal.common_slope * unit, normal.own_slope * own_unit
    # One solve for the slope and the mixed block: C^-1 [h, B^T].
    both = jnp.concatenate([own_slope[..., None], jnp.swapaxes(mixed, 1, 2)], axis=-1)
    solved = jnp.linalg.solve(own, both)
    reduced = common - jnp.einsum("vip,vpj->ij", mixed, solved[..., 1:])
    right = slope - jnp.einsum("vip,vp->i", mixed, solved[..., 0])
    lens = -jnp.linalg.solve(reduced, right)
    pose = -solved[..., 0] - jnp.einsum("vpj,j->vp", solved[..., 1:], lens)
    fall = -(slope @ lens) - (own_slope * pose).sum() + damping * ((lens**2).sum() + (pose**2).sum())
    return lens * unit, pose * own_unit, fall
