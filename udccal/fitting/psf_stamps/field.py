"""A psf field in stamps: images whose strengths are polynomials of the position, behind a map of polynomials.

With w the distance to the centre of the light, X the position, B_t(X) polynomials, and C_i(X) some mixtures of them,

    psf(w; X) = T(X) p(X) + 1 / |M(X)|  sum_i C_i(X) P_i(M(X)^-1 (w - L(X))),    M(X) = 1 + sum_t>0 B_t(X) M_t,
    C_0 = 1,    T(X) = sum_i C_i(X) integral P_i.

The map M stretches, shears and turns an image over the field, with few numbers. Images P_i are cubic B-splines on a
square grid of nodes and describe the rest. L, of polynomials too, is the distance of a colour's centre from the centre
that all colours of a stamp have in common. The pedestal p is the same all over a stamp, as far wings of a psf nearly
are. They differ from a background only by their growth with a star's light. That light is the images' T times a factor
of the star's own. T changes over the field as strengths do: p is a part of it. Over the field p changes, a polynomial
of degree 2: neither a map that stretches images nor images that take up light from others leave far wings as they are.

An image contains the mean over a pixel, and the map would stretch the pixel as well. Light that is stretched before
pixels average it differs, to second order in the pixel's size a = 1 px, by (a^2 / 24) tr((M^-1 M^-T - 1) D) of the
image, where D are its second derivatives.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Bool, Float, Int, Shaped
from numpy.polynomial.legendre import legvander

from udccal.models.arrays import Arrayish

TAPS = 4  # nodes along an axis under a cubic B-spline
# Parameters of one star: relative light, centre (x, y), the four numbers of its map, row by row, background, pedestal.
OWN, BACKGROUND, PEDESTAL = 9, 7, 8
# Coefficients of 1, f, f^2 and f^3 in the weight of each of these nodes.
_SPLINE = np.array([[1.0, 4.0, 1.0, 0.0], [-3.0, 0.0, 3.0, 0.0], [3.0, -6.0, 3.0, 0.0], [-1.0, 3.0, -3.0, 1.0]]) / 6
_Taps = Float[Array, "samples 4"]


class PsfField(eqx.Module):
    """The psf field of every colour.

    Attributes:
        nodes: B-spline coefficients of the images, in light per pixel.
        warp: the map's polynomials without the constant, which is 1.
        lateral: polynomials of lateral colour, in px (x, y), without the constant, which the images contain; of all
            planes except the reference, from which it is measured.
        mix: the polynomials' coefficients in the strength C of each image.
        pedestal: polynomials of the part of the images' light that each pixel of a stamp has in common with all others.
        spacing_px: between nodes.
    """

    nodes: Float[Arrayish, "planes images grid_rows grid_columns"]
    warp: Float[Arrayish, "planes warp_terms 2 2"]
    lateral: Float[Arrayish, "other_planes lateral_terms 2"]
    mix: Float[Arrayish, "images terms"]
    pedestal: Float[Arrayish, "planes pedestal_terms"]
    spacing_px: float = eqx.field(static=True)

    @property
    def reference(self) -> int:
        """The plane whose places are the stars': green, where there are three."""
        return 1 if len(self.nodes) == 3 else 0

    @property
    def dense(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What is not an image: numbers of the map, of lateral colour, and pedestals."""
        return np.asarray(self.warp), np.asarray(self.lateral), np.asarray(self.pedestal)

    def split(self, numbers: Shaped[np.ndarray, "numbers *k"]) -> list[Shaped[np.ndarray, "_ *k"]]:
        """Split an array over all numbers of ``dense`` into those of each part."""
        return np.split(numbers, np.cumsum([part.size for part in self.dense[:-1]]))

    @property
    def map_degree(self) -> int:
        """Highest degree of the map."""
        return degree_of(1 + self.warp.shape[1])

    def strengths(self, unit: Float[np.ndarray, "stars 2"]) -> Float[np.ndarray, "stars images"]:
        """Return C at positions scaled to about [-1, 1]."""
        return polynomials(unit, degree_of(self.mix.shape[1])) @ np.transpose(self.mix)

    def maps(self, unit: Float[np.ndarray, "stars 2"]) -> Float[np.ndarray, "stars planes 2 2"]:
        """Return M at positions scaled to about [-1, 1]."""
        return np.eye(2) + np.einsum("sm,pmij->spij", polynomials(unit, self.map_degree)[:, 1:], self.warp)

    def centres(self, unit: Float[np.ndarray, "stars 2"]) -> Float[np.ndarray, "stars planes 2"]:
        """Return L in px at positions scaled to about [-1, 1]."""
        every = np.insert(np.asarray(self.lateral), self.reference, 0.0, axis=0)
        return np.einsum("sm,pmi->spi", polynomials(unit, degree_of(1 + every.shape[1]))[:, 1:], every)

    def light(self, unit: Float[np.ndarray, "stars 2"]) -> Float[np.ndarray, "stars planes"]:
        """Return T at positions scaled to about [-1, 1]."""
        return self.strengths(unit) @ np.asarray(self.nodes).sum(axis=(2, 3)).T * self.spacing_px**2

    def pedestals(self, unit: Float[np.ndarray, "stars 2"]) -> Float[np.ndarray, "stars planes"]:
        """Return T p at positions scaled to about [-1, 1]."""
        return self.light(unit) * (polynomials(unit, degree_of(self.pedestal.shape[1])) @ np.transpose(self.pedestal))

    def moved(self, changes: Changes) -> PsfField:
        """Return the field after the first of these changes."""
        parts = zip(self.dense, self.split(changes.maps[:, 0]), strict=True)
        warp, lateral, pedestal = (old + own.reshape(np.shape(old)) for old, own in parts)
        nodes, mix = self.nodes + changes.nodes[..., 0], self.mix
        if changes.mix.size:
            # To first order in both: images as they were, with what strengths have changed by.
            nodes, mix = np.concatenate([nodes, self.nodes], axis=1), np.concatenate([mix, changes.mix[..., 0]])
        return replace(self, nodes=nodes, warp=warp, lateral=lateral, pedestal=pedestal, mix=mix)


class Changes(NamedTuple):
    """Changes of all unknowns, ``k`` at a time: parts of one vector, in this order.

    Attributes:
        stars: (x, y) in px, then relative light by colour, then background by colour in electrons.
        maps: the map's numbers, the lateral colour's, pedestals. With ``stars`` they form the equations' dense block.
        nodes: in the vector colour by colour and node by node, the images of a node together.
        mix: of the images' strengths; a vector may end before these, as a fit holds them.
    """

    stars: Float[np.ndarray, "stars own k"]
    maps: Float[np.ndarray, "numbers k"]
    nodes: Float[np.ndarray, "planes images grid_rows grid_columns k"]
    mix: Float[np.ndarray, "_ terms k"]

    @classmethod
    def of(cls, field: PsfField, stars: int, vector: Shaped[np.ndarray, "unknowns k"]) -> Changes:
        """Split a vector into its parts."""
        planes, images, *grid = field.nodes.shape
        ends = np.cumsum([stars * (2 + 2 * planes), sum(part.size for part in field.dense), field.nodes.size])
        own, maps, nodes, mix = np.split(vector, ends)
        nodes = np.moveaxis(nodes.reshape(planes, *grid, images, -1), 3, 1)
        terms = field.mix.shape[1]
        of_mix = mix.reshape(len(mix) // terms, terms, vector.shape[1])
        return cls(own.reshape(stars, 2 + 2 * planes, -1), maps, nodes, of_mix)


class Seen(NamedTuple):
    """A field's light in samples of stamps, per unit of a star's light.

    Attributes:
        jacobian: derivatives by a star's own parameters, of which there are ``OWN``.
        first: flat index of the first of 4 x 4 nodes.
        down, across: weights of these nodes times 1 / |M|, as a product.
        inside: True for samples on the grid.
    """

    value: Float[Arrayish, "stars samples"]
    jacobian: Float[Arrayish, "stars samples 9"]
    first: Int[Arrayish, "stars samples"]
    down: Float[Arrayish, "stars samples 4"]
    across: Float[Arrayish, "stars samples 4"]
    inside: Bool[Arrayish, "stars samples"]


def degree_of(terms: int) -> int:
    """Return the highest degree d of ``terms`` = (d + 1) (d + 2) / 2 polynomials."""
    return math.isqrt(2 * terms) - 1


def polynomials(unit: Float[np.ndarray, "stars 2"], degree: int) -> Float[np.ndarray, "stars terms"]:
    """Return all B_t up to a degree at positions scaled to about [-1, 1]; lower degrees are the first columns."""
    x, y = (legvander(part, degree) for part in unit.T)
    columns = [x[:, i] * y[:, total - i] for total in range(degree + 1) for i in range(total + 1)]
    return np.stack(columns, axis=1)


def see(
    field: PsfField,
    unit: Float[np.ndarray, "stars 2"],
    centre_px: Float[np.ndarray, "stars 2"],
    offset_px: Float[np.ndarray, "samples 2"],
    plane: Int[np.ndarray, "stars samples"],
) -> Seen:
    """Return values and derivatives at samples of colours ``plane``; centres and samples are (x, y) in px."""
    planes, count, rows, columns = field.nodes.shape
    images = field.strengths(unit) @ np.asarray(field.nodes).reshape(planes, count, -1)
    # One compilation serves all orders, stars eight at a time, and numbers of nodes up to a multiple of this.
    filled = _filled(np.moveaxis(images, 0, 1), 2, 16384)
    by_star = (filled, field.maps(unit), centre_px[:, None] + field.centres(unit), plane.astype(np.int32))
    grid = np.int32(rows), np.int32(columns), np.float64(field.spacing_px)
    parts = ([_filled(part[at : at + 8], 0, 8) for part in by_star] for at in range(0, len(unit), 8))
    by_part = [response(*part, offset_px, *grid) for part in parts]
    seen = Seen(*(np.concatenate(part)[: len(unit)] for part in zip(*by_part, strict=True)))
    common, jacobian = np.take_along_axis(field.pedestals(unit), plane, axis=1), seen.jacobian.copy()
    jacobian[..., 0] += common
    return seen._replace(value=seen.value + common, jacobian=jacobian)


def taps(seen: Seen, used: Int[np.ndarray, " used"], grid: tuple[int, ...]) -> scipy.sparse.csr_array:
    """Return the matrix from the nodes of each star's image to the samples ``used`` (flat, in order)."""
    stars, samples = seen.first.shape
    step = (np.arange(TAPS)[:, None] * grid[1] + np.arange(TAPS)).ravel()
    index = seen.first.ravel()[used, None] + step + grid[0] * grid[1] * (used // samples)[:, None]
    down, across = (part.reshape(-1, TAPS)[used] for part in (seen.down, seen.across))
    ends, shape = np.arange(0, index.size + 1, TAPS**2), (len(used), grid[0] * grid[1] * stars)
    return scipy.sparse.csr_array(((down[:, :, None] * across[:, None]).ravel(), index.ravel(), ends), shape=shape)


def by_maps(
    field: PsfField, unit: Float[np.ndarray, "stars 2"], plane: int
) -> tuple[Int[np.ndarray, " own"], scipy.sparse.csr_array]:
    """Return which numbers of ``Changes.maps`` a colour depends on, and the matrix from these to the stars' own."""
    one = np.eye(OWN)
    warp, lateral, pedestal = field.split(np.arange(sum(part.size for part in field.dense)))
    index, basis = [warp.reshape(field.warp.shape)[plane].ravel()], polynomials(unit, field.map_degree)[:, 1:]
    parts = [scipy.sparse.kron(basis, one[:, 3:7])]
    if plane != field.reference:
        index.append(lateral.reshape(field.lateral.shape)[plane - (plane > field.reference)].ravel())
        basis = polynomials(unit, degree_of(1 + field.lateral.shape[1]))[:, 1:]
        parts.append(scipy.sparse.kron(basis, one[:, 1:3]))
    index.append(pedestal.reshape(field.pedestal.shape)[plane])
    # The images' light hardly changes with a step: a pedestal is a small part of it.
    basis = field.light(unit)[:, [plane]] * polynomials(unit, degree_of(field.pedestal.shape[1]))
    parts.append(scipy.sparse.kron(basis, one[:, [PEDESTAL]]))
    return np.concatenate(index), scipy.sparse.csr_array(scipy.sparse.hstack(parts, format="csr"))


def changes_of_images(
    field: PsfField, unit: Float[np.ndarray, "stars 2"], changes: Changes, plane: int
) -> Float[np.ndarray, "stars grid_rows grid_columns k"]:
    """Return changes of a colour's image at each star."""
    # In the order of the vector: no copy of the nodes of all images is made.
    images = np.moveaxis(field.strengths(unit) @ np.moveaxis(changes.nodes[plane], 0, 2), 2, 0)
    if changes.mix.size:
        strengths = np.tensordot(polynomials(unit, degree_of(field.mix.shape[1])), changes.mix, axes=(1, 1))
        images += np.einsum("stk,tyx->syxk", strengths, field.nodes[plane])
    return images


def changes_of_light(
    seen: Seen,
    own: Float[np.ndarray, "parameters k"],
    images: Float[np.ndarray, "stars grid_rows grid_columns k"],
    used: Int[np.ndarray, " used"],
) -> Float[np.ndarray, "used k"]:
    """Return changes of light in samples under changes of stars' own parameters, and of a colour's images."""
    stars, samples, count = seen.jacobian.shape
    by_own = (seen.jacobian @ own.reshape(stars, count, own.shape[1])).reshape(stars * samples, own.shape[1])
    weights = taps(seen, used, images.shape[1:3])
    return by_own[used] + weights @ images.reshape(weights.shape[1], own.shape[1])


def _filled(values: Shaped[np.ndarray, "..."], axis: int, multiple: int) -> Shaped[np.ndarray, "..."]:
    """Repeat the last entry along an axis up to a multiple."""
    widths = [(0, -values.shape[axis] % multiple if one == axis else 0) for one in range(values.ndim)]
    return np.pad(values, widths, mode="edge")


@jax.jit
def response(
    images: Float[Array, "stars planes nodes"],
    maps: Float[Array, "stars planes 2 2"],
    centres: Float[Array, "stars planes 2"],
    plane: Int[Array, "stars samples"],
    offset_px: Float[Array, "samples 2"],
    rows: Int[Arrayish, ""],
    columns: Int[Arrayish, ""],
    spacing_px: Float[Arrayish, ""],
) -> Seen:
    """Compute ``see`` from images, maps and centres at each star; nodes beyond ``rows * columns`` are padding."""

    def star(image: Array, warp: Array, centre: Array, own: Array) -> Seen:
        # The explicit inverse: a decomposition, even of 2 x 2, takes long to compile.
        thinner = 1.0 / (warp[:, 0, 0] * warp[:, 1, 1] - warp[:, 0, 1] * warp[:, 1, 0])
        turned = jnp.stack([warp[:, 1, 1], -warp[:, 0, 1], -warp[:, 1, 0], warp[:, 0, 0]], axis=1)
        inverse, scale = (thinner[:, None] * turned).reshape(-1, 2, 2)[own], thinner[own]
        at = jnp.sum(inverse * (offset_px - centre[own])[:, None, :], axis=2)
        shrunk = jnp.sum(inverse[:, :, None] * inverse[:, None], axis=3) / (24 * spacing_px**2)
        pixel = shrunk - jnp.eye(2) / (24 * spacing_px**2)
        first_y, down, by_y, bend_y, inside_y = _weights(at[:, 1] / spacing_px + (rows - 1) / 2, rows, pixel[:, 1, 1])
        first_x, across, by_x, bend_x, inside_x = _weights(
            at[:, 0] / spacing_px + (columns - 1) / 2, columns, pixel[:, 0, 0]
        )
        first, step = first_y * columns + first_x, jnp.arange(TAPS)
        index = first[:, None, None] + step[:, None] * columns + step
        patch = image.ravel()[own[:, None, None] * image.shape[1] + index]
        level, rising, bent = (jnp.sum(patch * by[:, None, :], axis=2) for by in (across, by_x, bend_x))
        # The mixed derivative is no product; it is the only part that ``down`` and ``across`` do not contain.
        mixed, turn = jnp.sum(rising * by_y, axis=1), 2 * pixel[:, 0, 1]
        value = scale * (jnp.sum(level * down, axis=1) + turn * mixed)
        rise_x = jnp.sum(rising * down, axis=1) + turn * jnp.sum(bent * by_y, axis=1)
        rise_y = jnp.sum(level * by_y, axis=1) + turn * jnp.sum(rising * bend_y, axis=1)
        rise = jnp.stack([rise_x, rise_y], axis=1)
        rise = jnp.sum((scale / spacing_px)[:, None, None] * rise[:, :, None] * inverse, axis=1)
        # By the map: the image's place, its area, and the pixel that it does not stretch.
        second = jnp.stack([jnp.sum(bent * down, axis=1), mixed, mixed, jnp.sum(level * bend_y, axis=1)], axis=1)
        second = scale[:, None, None] * second.reshape(-1, 2, 2)
        by_map = -rise[:, :, None] * at[:, None, :] - value[:, None, None] * inverse.transpose(0, 2, 1)
        by_map -= 2 * jnp.einsum("sai,sab,sbj->sij", inverse, second, shrunk)
        jacobian = jnp.concatenate([value[:, None], -rise, by_map.reshape(-1, 4), jnp.ones((len(value), 2))], axis=1)
        return Seen(value, jacobian, first, scale[:, None] * down, across, inside_y & inside_x)

    return jax.vmap(star)(images, maps, centres, plane)


def _weights(
    place: Float[Array, " samples"], nodes: Int[Arrayish, ""], pixel: Float[Array, " samples"]
) -> tuple[Int[Array, " samples"], _Taps, _Taps, _Taps, Bool[Array, " samples"]]:
    """Return first node, weights, derivatives, and True where all four nodes exist (else the weights are zero).

    Weights and first derivatives include ``pixel`` times their second derivative; the plain second one comes last.
    """
    cell = jnp.floor(place)
    first = cell.astype(jnp.int32) - 1
    inside = (first >= 0) & (first + TAPS <= nodes)
    # Powers of the distance from the second node, and their derivatives.
    f, zero = place - cell, jnp.zeros_like(place)
    powers = (zero + 1, f, f**2, f**3), (zero, zero + 1, 2 * f, 3 * f**2), (zero, zero, zero + 2, 6 * f)
    value, slope, bend = (jnp.where(inside[:, None], jnp.stack(p, axis=1) @ _SPLINE, 0.0) for p in powers)
    third = jnp.where(inside[:, None], _SPLINE[3] * 6, 0.0)
    own, rise = (part + pixel[:, None] * more for part, more in ((value, bend), (slope, third)))
    return jnp.clip(first, 0, nodes - TAPS), own, rise, bend, inside
