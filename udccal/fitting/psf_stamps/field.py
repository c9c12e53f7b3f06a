"""A psf field seen in stamps: an image whose nodes are polynomials of the position, behind a map that is one as well.

With w the distance to the centre of the light, X the position and B_t(X) polynomials,

    psf(w; X) = 1 / |M(X)|  sum_t B_t(X) P_t(M(X)^-1 (w - L(X))),    M(X) = 1 + sum_t>0 B_t(X) M_t.

The map M says how an image is stretched, sheared and turned over the field, which takes few numbers; images P_t, cubic
B-splines on a square grid of nodes, carry the rest. L, polynomials too, is how far a colour lies beside the centre
that all colours of a stamp share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.polynomial.legendre import legvander

from udccal.models.arrays import Arrayish
from udccal.models.fields import polynomial_basis, polynomial_terms

TAPS = 4  # nodes along an axis under a cubic B-spline
# Arrays are filled up to a multiple of so many nodes and stars, and to polynomials of at least this degree.
_NODES, _STARS, _HIGHEST = 4096, 8, 4


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


@dataclass(frozen=True)
class Changes:
    """Changes of all that is unknown, ``k`` of them at a time: parts of one vector, whose order is that of the fields.

    Attributes:
        stars: (x, y) in px, then relative light by colour.
        warp, lateral: by colour, flat. With ``stars`` they make the dense block of the equations.
        nodes: by colour; in the vector node by node, the images of a node together.
    """

    stars: Float[np.ndarray, "stars own k"]
    warp: tuple[Float[np.ndarray, "_warp k"], ...]
    lateral: tuple[Float[np.ndarray, "_lateral k"], ...]
    nodes: tuple[Float[np.ndarray, "_terms _nodes k"], ...]

    @classmethod
    def of(cls, fields: tuple[PlaneField, ...], stars: int, vector: Float[np.ndarray, "unknowns k"]) -> Changes:
        """The parts of a vector."""
        sizes = [stars * (2 + len(fields))]
        sizes += [np.size(part) for field in fields for part in (field.warp, field.lateral)]
        own, *parts = np.split(vector, np.cumsum(sizes + [np.size(field.nodes) for field in fields])[:-1])
        k, maps, nodes = vector.shape[1], parts[: 2 * len(fields)], parts[2 * len(fields) :]
        images = (
            part.reshape(-1, len(field.nodes), k).transpose(1, 0, 2) for field, part in zip(fields, nodes, strict=True)
        )
        return cls(own.reshape(stars, -1, k), tuple(maps[::2]), tuple(maps[1::2]), tuple(images))

    def applied(self, fields: tuple[PlaneField, ...]) -> tuple[PlaneField, ...]:
        """The fields after the first of the changes."""
        return tuple(
            replace(
                field,
                nodes=field.nodes + nodes[..., 0].reshape(field.nodes.shape),
                warp=field.warp + warp[:, 0].reshape(-1, 2, 2),
                lateral=field.lateral + lateral[:, 0].reshape(-1, 2),
            )
            for field, nodes, warp, lateral in zip(fields, self.nodes, self.warp, self.lateral, strict=True)
        )


class Seen(NamedTuple):
    """What a field brings to samples of stamps, per unit of light, and how it answers to its unknowns.

    Attributes:
        value: per unit of light.
        slopes: of the value to the centre (x, y) and to the map (row by row).
        first: flat index of the first of 4 x 4 nodes.
        down, across: weights of these nodes times 1 / |M|, as a product.
        inside: whether the sample lies on the grid.
    """

    value: Float[Arrayish, "stars samples"]
    slopes: Float[Arrayish, "stars samples 6"]
    first: Int[Arrayish, "stars samples"]
    down: Float[Arrayish, "stars samples 4"]
    across: Float[Arrayish, "stars samples 4"]
    inside: Bool[Arrayish, "stars samples"]


def degrees(highest: int) -> Int[np.ndarray, " terms"]:
    """Of every polynomial up to a degree, in their order."""
    return np.repeat(np.arange(highest + 1), np.arange(1, highest + 2))


def polynomials(unit: Float[Arrayish, "stars 2"], degree: int) -> Float[np.ndarray, "stars terms"]:
    """All B_t up to a degree at positions scaled to about [-1, 1]; lower degrees are the first columns of higher."""
    x, y = (legvander(np.asarray(part, dtype=np.float64), degree) for part in np.asarray(unit).T)
    columns = [x[:, i] * y[:, total - i] for total in range(degree + 1) for i in range(total + 1)]
    return np.stack(columns, axis=1)


def warps(field: PlaneField, unit: Float[Arrayish, "stars 2"]) -> Float[np.ndarray, "stars 2 2"]:
    """M at positions scaled to about [-1, 1]."""
    return np.eye(2) + np.einsum("sm,mij->sij", polynomials(unit, field.warp_degree)[:, 1:], np.asarray(field.warp))


def see(
    field: PlaneField,
    unit: Float[Arrayish, "stars 2"],
    centre_px: Float[Arrayish, "stars 2"],
    offset_px: Float[Arrayish, "stars samples 2"],
) -> Seen:
    """Values and slopes at samples; numpy's where all that is given is.

    Args:
        field: of one colour.
        unit: positions scaled to about [-1, 1].
        centre_px: of the light that all colours share, (x, y) from each stamp's middle sample.
        offset_px: of samples, (x, y) from each stamp's middle sample.
    """
    # What is compiled knows neither orders nor how many nodes and stars there are: a fit that tries many compiles once.
    degree = max(field.image_degree, field.warp_degree, field.lateral_degree, _HIGHEST)
    terms, (rows, columns) = polynomial_terms(degree), np.shape(field.nodes)[1:]
    most = rows * columns + -rows * columns % _NODES
    stars = np.shape(unit)[0]
    many = stars + -stars % _STARS
    padded = Padded(
        images=_filled(field.nodes.reshape(-1, rows * columns), (terms, most)),
        warp=_filled(field.warp, (terms - 1, 2, 2)),
        lateral=_filled(field.lateral, (terms - 1, 2)),
        rows=np.int32(rows),
        columns=np.int32(columns),
        spacing_px=np.float64(field.spacing_px),
    )
    basis = polynomial_basis(unit, degree) if isinstance(unit, jax.Array) else polynomials(unit, degree)
    own = _filled(centre_px, (many, 2)), _filled(offset_px, (many, *np.shape(offset_px)[1:]))
    seen = _see(padded, _filled(basis, (many, terms)), *own)
    if any(isinstance(part, jax.Array) for part in (field.nodes, field.warp, field.lateral, unit, centre_px)):
        return Seen(*(part[:stars] for part in seen))
    return Seen(*(np.asarray(part)[:stars] for part in seen))


class Padded(NamedTuple):
    """A field whose images and polynomials are filled up with zeros; how many nodes there are, and how far apart."""

    images: Float[Arrayish, "terms nodes"]
    warp: Float[Arrayish, "terms_less_1 2 2"]
    lateral: Float[Arrayish, "terms_less_1 2"]
    rows: Int[Arrayish, ""]
    columns: Int[Arrayish, ""]
    spacing_px: Float[Arrayish, ""]


def _filled(values: Arrayish, shape: tuple[int, ...]) -> Arrayish:
    """``values`` with zeros behind them, along every axis."""
    place = tuple(slice(0, size) for size in np.shape(values))
    if isinstance(values, jax.Array):
        return jnp.zeros(shape, values.dtype).at[place].set(values)
    out = np.zeros(shape)
    out[place] = values
    return out


@jax.jit
def _see(
    field: Padded,
    basis: Float[Array, "stars terms"],
    centre_px: Float[Array, "stars 2"],
    offset_px: Float[Array, "stars samples 2"],
) -> Seen:
    maps = jnp.eye(2) + jnp.einsum("sm,mij->sij", basis[:, 1:], field.warp)
    own = centre_px + basis[:, 1:] @ field.lateral
    return jax.vmap(_see_star, in_axes=(0, None, 0, 0, 0))(basis @ field.images, field, maps, own, offset_px)


def _see_star(
    image: Float[Array, " nodes"],
    grid: Padded,
    warp: Float[Array, "2 2"],
    centre: Float[Array, "2"],
    offset: Float[Array, "samples 2"],
) -> Seen:
    # By hand: a decomposition, even of 2 x 2, takes long to compile.
    thinner = 1.0 / (warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0])
    inverse = thinner * jnp.array([[warp[1, 1], -warp[0, 1]], [-warp[1, 0], warp[0, 0]]])
    at = (offset - centre) @ inverse.T
    spacing = grid.spacing_px
    first_y, down, down_slope, inside_y = _taps(at[:, 1] / spacing + (grid.rows - 1) / 2, grid.rows)
    first_x, across, across_slope, inside_x = _taps(at[:, 0] / spacing + (grid.columns - 1) / 2, grid.columns)
    step = jnp.arange(TAPS)
    patch = image[(first_y[:, None] + step)[:, :, None] * grid.columns + (first_x[:, None] + step)[:, None, :]]
    level, rising = (jnp.sum(patch * by[:, None, :], axis=2) for by in (across, across_slope))
    value = thinner * jnp.sum(level * down, axis=1)
    rise_x, rise_y = jnp.sum(rising * down, axis=1), jnp.sum(level * down_slope, axis=1)
    rise = thinner / spacing * jnp.stack([rise_x, rise_y], axis=1) @ inverse
    by_map = -rise[:, :, None] * at[:, None, :] - value[:, None, None] * inverse.T
    slopes = jnp.concatenate([-rise, by_map.reshape(-1, 4)], axis=1)
    return Seen(value, slopes, first_y * grid.columns + first_x, thinner * down, across, inside_y & inside_x)


def _taps(
    place: Float[Array, " samples"], nodes: Int[Arrayish, ""]
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
