"""A psf field seen in stamps: an image whose nodes are polynomials of the position, behind a map that is one as well.

With w the distance to the centre of the light, X the position and B_t(X) polynomials,

    psf(w; X) = 1 / |M(X)|  sum_t B_t(X) P_t(M(X)^-1 (w - L(X))),    M(X) = 1 + sum_t>0 B_t(X) M_t.

The map M says how an image is stretched, sheared and turned over the field, which takes few numbers; images P_t, cubic
B-splines on a square grid of nodes, carry the rest. L, polynomials too, is how far a colour lies beside the centre
that all colours of a stamp share.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from udccal.models.arrays import Arrayish
from udccal.models.fields import polynomial_basis

TAPS = 4  # nodes along an axis that a cubic B-spline listens to
# What a star may change by itself: relative light, centre (x, y), and the four numbers of its map, row by row.
OWN = 7


class PlaneField(eqx.Module):
    """The psf field of one colour.

    Attributes:
        nodes: B-spline coefficients of the images, in light per pixel.
        warp: the map's polynomials without the constant, which is 1.
        lateral: of the place, in px (x, y), without the constant, which the images carry.
        spacing_px: between nodes.
    """

    nodes: Float[Arrayish, "terms grid_rows grid_columns"]
    warp: Float[Arrayish, "warp_terms 2 2"]
    lateral: Float[Arrayish, "lateral_terms 2"]
    image_degree: int = eqx.field(static=True)
    warp_degree: int = eqx.field(static=True)
    lateral_degree: int = eqx.field(static=True)
    spacing_px: float = eqx.field(static=True)


class Seen(NamedTuple):
    """What a field brings to samples of stamps, per unit of light, and how it answers to its unknowns.

    Attributes:
        value: per unit of light.
        slopes: of the value to the centre (x, y) and to the map (row by row).
        first: flat index of the first of 4 x 4 nodes.
        down, across: weights of these nodes times 1 / |M|, as a product.
        inside: whether the sample lies on the grid.
    """

    value: Float[Array, "stars samples"]
    slopes: Float[Array, "stars samples 6"]
    first: Int[Array, "stars samples"]
    down: Float[Array, "stars samples 4"]
    across: Float[Array, "stars samples 4"]
    inside: Bool[Array, "stars samples"]


def image_basis(field: PlaneField, unit: Float[Arrayish, "stars 2"]) -> Float[Array, "stars terms"]:
    """B_t of the images at positions scaled to about [-1, 1]."""
    return polynomial_basis(unit, field.image_degree)


def warps(field: PlaneField, unit: Float[Arrayish, "stars 2"]) -> Float[Array, "stars 2 2"]:
    """M at positions scaled to about [-1, 1]."""
    basis = polynomial_basis(unit, field.warp_degree)[:, 1:]
    return jnp.eye(2) + jnp.einsum("sm,mij->sij", basis, jnp.asarray(field.warp))


def laterals(field: PlaneField, unit: Float[Arrayish, "stars 2"]) -> Float[Array, "stars 2"]:
    """L in px (x, y)."""
    return polynomial_basis(unit, field.lateral_degree)[:, 1:] @ jnp.asarray(field.lateral)


@eqx.filter_jit
def see(
    field: PlaneField,
    unit: Float[Arrayish, "stars 2"],
    centre_px: Float[Arrayish, "stars 2"],
    offset_px: Float[Arrayish, "stars samples 2"],
) -> Seen:
    """Values and slopes at samples.

    Args:
        field: of one colour.
        unit: positions scaled to about [-1, 1].
        centre_px: of the light that all colours share, (x, y) from each stamp's middle sample.
        offset_px: of samples, (x, y) from each stamp's middle sample.
    """
    images = jnp.einsum("st,tyx->syx", image_basis(field, unit), jnp.asarray(field.nodes))
    maps, own = warps(field, unit), jnp.asarray(centre_px) + laterals(field, unit)
    return jax.vmap(_see_star, in_axes=(0, 0, 0, 0, None))(images, maps, own, jnp.asarray(offset_px), field.spacing_px)


def _see_star(
    image: Float[Array, "grid_rows grid_columns"],
    warp: Float[Array, "2 2"],
    centre: Float[Array, "2"],
    offset: Float[Array, "samples 2"],
    spacing: float,
) -> Seen:
    inverse = jnp.linalg.inv(warp)
    thinner = 1.0 / jnp.linalg.det(warp)
    at = (offset - centre) @ inverse.T
    rows, columns = image.shape
    first_y, down, down_slope, inside_y = _taps(at[:, 1] / spacing + (rows - 1) / 2, rows)
    first_x, across, across_slope, inside_x = _taps(at[:, 0] / spacing + (columns - 1) / 2, columns)
    step = jnp.arange(TAPS)
    patch = image[(first_y[:, None] + step)[:, :, None], (first_x[:, None] + step)[:, None, :]]
    value = thinner * jnp.einsum("nj,nji,ni->n", down, patch, across)
    rise_x = jnp.einsum("nj,nji,ni->n", down, patch, across_slope)
    rise_y = jnp.einsum("nj,nji,ni->n", down_slope, patch, across)
    rise = thinner / spacing * jnp.stack([rise_x, rise_y], axis=1) @ inverse
    by_map = -rise[:, :, None] * at[:, None, :] - value[:, None, None] * inverse.T
    slopes = jnp.concatenate([-rise, by_map.reshape(-1, 4)], axis=1)
    return Seen(value, slopes, first_y * columns + first_x, thinner * down, across, inside_y & inside_x)


def _taps(
    place: Float[Array, " samples"], nodes: int
) -> tuple[Int[Array, " samples"], Float[Array, "samples 4"], Float[Array, "samples 4"], Bool[Array, " samples"]]:
    """First node, weights and their slopes, and whether all four nodes exist (else the weights are zero)."""
    cell = jnp.floor(place)
    f = (place - cell)[:, None]
    first = cell.astype(jnp.int32) - 1
    inside = (first >= 0) & (first + TAPS <= nodes)
    g = 1.0 - f
    weights = jnp.concatenate(
        [g**3 / 6, (3 * f**3 - 6 * f**2 + 4) / 6, (3 * g**3 - 6 * g**2 + 4) / 6, f**3 / 6], axis=1
    )
    slopes = jnp.concatenate([-(g**2) / 2, (3 * f**2 - 4 * f) / 2, (4 * g - 3 * g**2) / 2, f**2 / 2], axis=1)
    kept = inside[:, None]
    return jnp.clip(first, 0, nodes - TAPS), jnp.where(kept, weights, 0.0), jnp.where(kept, slopes, 0.0), inside
