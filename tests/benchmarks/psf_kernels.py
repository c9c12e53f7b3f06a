"""The kernel of diffraction and its derivatives by automatic differentiation, to hold the fit's own against."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.fitting.psf.kernel import HEAD, PITCH, PUPIL, Evaluator
from udccal.models.arrays import Arrayish
from udccal.models.diffraction import LocalFrame, average_transfer, local_frame
from udccal.models.geometry import Geometry
from udccal.models.interference import (
    footprint_place,
    interference_transfer,
    node_overlaps,
    overlap_tables,
    strengths,
)
from udccal.models.lattice import sample, spline_coefficients
from udccal.models.psf import lattice_points

# Overlaps of the pupil's footprint depend on the pitch and on the pupil.
_IN_OVERLAPS = np.array([PITCH, PUPIL])


@eqx.filter_jit
def kernel_and_slopes(
    evaluator: Evaluator, theta: Float[Arrayish, " p"], geometry: Geometry, position: Float[Arrayish, "2"], *size: int
) -> tuple[Float[Array, "3 rows columns"], Float[Array, "p 3 rows columns"]]:
    """The diffraction kernel of ``size`` rows and columns at a position, and its derivatives by all parameters."""
    frame = local_frame(geometry, position)
    y, x = jnp.meshgrid(*(jnp.arange(n) - n // 2 for n in size), indexing="ij")
    points, density = lattice_points(geometry, frame, position, jnp.stack([x.ravel(), y.ravel()], axis=-1) * 1.0)
    light, slopes = light_and_slopes(evaluator, theta, frame, points, density, 0.0)
    return light.T.reshape(3, *size), jnp.moveaxis(slopes, -1, 1).reshape(-1, 3, *size)


@eqx.filter_jit
def light_and_slopes(
    evaluator: Evaluator,
    theta: Float[Arrayish, " p"],
    frame: LocalFrame,
    points: Float[Arrayish, "n 2"],
    density: Float[Arrayish, " n"],
    disc_px: Float[Arrayish, ""],
) -> tuple[Float[Array, "n 3"], Float[Array, "p n 3"]]:
    """What one unit of light brings to points of a lattice, and its derivatives by all parameters.

    ``points`` and ``density`` as of ``models.psf.lattice_points``; ``disc_px`` is the diameter of the source.
    """
    at, grid = jnp.asarray(theta), evaluator.lattice
    spectra = jnp.asarray(evaluator.model(at).spectrum)

    def overlaps(values: Float[Array, " p"]) -> Float[Array, "nodes terms rows half"]:
        model = evaluator.model(values)
        return node_overlaps(model, frame, grid, overlap_tables(model, frame))

    def lit(
        values: Float[Array, " p"], own: Float[Array, "nodes terms rows half"] | None, light: Float[Array, "3 nodes"]
    ) -> Float[Array, "n 3"]:
        model = evaluator.model(values)
        transfer = average_transfer(model, frame, grid, light, disc_px, shaped=evaluator.shaped)
        if own is not None:
            strength = strengths(model, footprint_place(model, frame))
            transfer = transfer + interference_transfer(model, frame, grid, light, own, strength, disc_px)
        return sample(grid, spline_coefficients(grid, transfer), jnp.asarray(points)) * jnp.asarray(density)[:, None]

    def along(way: Float[Array, " p"]) -> Float[Array, "n 3"]:
        return jax.jvp(lambda values: lit(values, here, spectra), (at,), (way,))[1]

    def through_overlaps(way: Float[Array, " p"]) -> Float[Array, "n 3"]:
        return jax.jvp(lambda values: lit(at, overlaps(values), spectra), (at,), (way,))[1]

    here = overlaps(at) if evaluator.interference else None
    each = jnp.eye(HEAD, jnp.size(at))
    slopes = jax.lax.map(along, each)
    if here is not None:
        # Apart, since the overlaps are by far the slowest to follow.
        slopes = slopes.at[_IN_OVERLAPS].add(jax.lax.map(through_overlaps, each[_IN_OVERLAPS]))
    # The light is linear in the spectra, which are normalised exponentials.
    nodes = jax.lax.map(lambda one: lit(at, here, jnp.tile(one, (3, 1))), jnp.eye(spectra.shape[1]))
    light = jnp.einsum("jnc,cj->nc", nodes, spectra)
    by_log = jnp.einsum("cd,cj,jnc->cjnd", jnp.eye(3), spectra, nodes - light)
    return light, jnp.concatenate([slopes, by_log.reshape(-1, *light.shape)])
