"""How sure it is where a ray lands: the covariance of intrinsics and poses carried to pixels.

Intrinsics and poses share a freedom: a lens whose centre is a pixel off and a camera that is turned by as much see
nearly the same. What a ray's place means therefore depends on what the ray is fixed to (the gauge). Compare Kogan,
"Projection uncertainty" in the documentation of mrcal, whose choice is ``BOARDS``.
"""

from __future__ import annotations

import enum

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.fitting.geometry.bundle_normal import INTRINSICS
from udccal.fitting.geometry.bundle_points import bucket
from udccal.fitting.geometry.bundle_solve import Bundle
from udccal.models.geometry import Geometry, project, rotation_matrix, unproject
from udccal.numerics import in_float64

_GRID = 9
_EDGE = 0.02


class Gauge(enum.Enum):
    """What a ray stays fixed to while the calibration varies."""

    CAMERA = "the camera's axes as fitted: the freedom between centre and rotation shows in full"
    BOARDS = "the boards, on average over the views: the camera's axes turn with the poses"
    ALIGNED = "the rotation that brings the whole picture into its best agreement: the shape of the lens alone"


@in_float64
def projection_covariance(
    bundle: Bundle,
    cov: Float[np.ndarray, "n n"],
    image_size: tuple[int, int],
    pixels: Float[np.ndarray, "rays 2"],
    gauge: Gauge,
) -> Float[np.ndarray, "rays 2 2"]:
    """Covariance in px^2 of where the rays of these pixels land.

    Args:
        bundle: what was fitted.
        cov: of intrinsics and poses, in that order.
        image_size: (columns, rows); the picture that ``Gauge.ALIGNED`` agrees over, as a 9 x 9 grid.
        pixels: where the rays land by the fit.
        gauge: what the rays stay fixed to.
    """
    by_lens, by_turn = ray_slopes(bundle.intrinsics, pixels)
    if gauge is Gauge.BOARDS:
        turn = mean_turn(bundle)
    elif gauge is Gauge.ALIGNED:
        turn = _aligning_turn(bundle, image_size, len(cov))
    else:
        turn = np.zeros((3, len(cov)))
    slope = np.einsum("nai,ij->naj", by_turn, turn)
    slope[..., :INTRINSICS] += by_lens
    return np.einsum("nai,ij,nbj->nab", slope, cov, slope)


def field_grid(image_size: tuple[int, int]) -> Float[np.ndarray, "81 2"]:
    """9 x 9 pixels over the picture, 2 % away from its edges."""
    place = np.linspace(_EDGE, 1 - _EDGE, _GRID)
    x, y = np.meshgrid(place * (image_size[0] - 1), place * (image_size[1] - 1))
    return np.stack([x.ravel(), y.ravel()], axis=1)


@in_float64
def ray_slopes(
    intrinsics: Float[np.ndarray, "9"], pixels: Float[np.ndarray, "rays 2"]
) -> tuple[Float[np.ndarray, "rays 2 9"], Float[np.ndarray, "rays 2 3"]]:
    """Of where fixed rays land: by the intrinsics, and by a small rotation of the rays in camera coordinates."""
    padded = np.tile(intrinsics[2:4], (bucket(len(pixels)), 1))
    padded[: len(pixels)] = pixels
    lens, turn = (np.asarray(part) for part in _compiled_slopes(intrinsics, padded))
    return lens[: len(pixels)], turn[: len(pixels)]


@jax.jit
def _compiled_slopes(intrinsics: Array, pixels: Array) -> tuple[Array, Array]:
    def camera(x: Array) -> Geometry:
        return Geometry(x[:2], x[2:4], x[4:9], jnp.zeros(3), jnp.zeros(3))

    ideal = unproject(camera(intrinsics), pixels)
    rays = jnp.concatenate([ideal, jnp.ones_like(ideal[:, :1])], axis=1)

    def seen(x: Array, turn: Array) -> Array:
        return project(camera(x), rays @ rotation_matrix(turn).T)

    return jax.jacfwd(seen, argnums=(0, 1))(intrinsics, jnp.zeros(3))


@in_float64
def mean_turn(bundle: Bundle) -> Float[np.ndarray, "3 n"]:
    """Mean over the views of the small rotation that a change of the pose turns the board by, in camera coordinates."""
    views = len(bundle.poses)
    turn = np.zeros((3, INTRINSICS + 6 * views))
    slopes = np.asarray(_turn_slopes(bundle.poses[:, :3]))
    for view in range(views):
        turn[:, INTRINSICS + 6 * view : INTRINSICS + 6 * view + 3] = slopes[view] / views
    return turn


@jax.jit
@jax.vmap
def _turn_slopes(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    at = rotation_matrix(vector)

    def turn(x: Array) -> Array:
        small = rotation_matrix(x) @ at.T
        return jnp.stack([small[2, 1] - small[1, 2], small[0, 2] - small[2, 0], small[1, 0] - small[0, 1]]) / 2

    return jax.jacfwd(turn)(vector)


def _aligning_turn(bundle: Bundle, image_size: tuple[int, int], size: int) -> Float[np.ndarray, "3 n"]:
    """The rotation that undoes, as well as a rotation can over the picture, what a change of the intrinsics does."""
    lens, turn = ray_slopes(bundle.intrinsics, field_grid(image_size))
    undo = np.zeros((3, size))
    undo[:, :INTRINSICS] = -np.linalg.lstsq(turn.reshape(-1, 3), lens.reshape(-1, INTRINSICS), rcond=None)[0]
    return undo
