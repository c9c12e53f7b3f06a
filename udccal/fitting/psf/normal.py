"""Normal equations of the diffraction fit, one field position at a time.

The kernel is linear in the spectra, so one evaluation for every wavelength node serves all colours and all their
derivatives; for those by the few other parameters see ``psf.slopes``.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from jaxtyping import ArrayLike as Arrayish

from udccal.fitting.psf.blocks import PITCH, PUPIL, Block, Local, corrected, unpack
from udccal.fitting.psf.slopes import factors_by_parameter, kernel_slopes
from udccal.models.diffraction import Diffraction, LocalFrame, average_transfer
from udccal.models.interference import interference_transfer, node_overlaps, overlap_tables
from udccal.models.lattice import Lattice, sample, spline_coefficients

HUBER = 3.0


class Evaluator(eqx.Module):
    """What stays the same from call to call.

    Attributes:
        wavelengths_nm: nodes of the spectra.
        lattice: for the transfer functions.
        interference: whether the footprint's place on the rows is known.
    """

    wavelengths_nm: Float[Arrayish, " nodes"]
    lattice: Lattice = eqx.field(static=True)
    interference: bool = eqx.field(static=True)

    def model(self, theta: Float[Arrayish, " p"]) -> Diffraction:
        """The model that a vector of global parameters stands for."""
        return unpack(theta, self.wavelengths_nm, self.interference)


class Normal(eqx.Module):
    """Sums over samples of products of derivatives: global x global, global x local, local x local."""

    gg: Float[Arrayish, "p p"]
    gl: Float[Arrayish, "shots p l"]
    ll: Float[Arrayish, "shots l l"]
    g: Float[Arrayish, " p"]
    l: Float[Arrayish, "shots l"]  # noqa: E741
    cost: Float[Arrayish, ""]


@eqx.filter_jit
def overlaps_of(
    evaluator: Evaluator, theta: Float[Arrayish, " p"], frame: LocalFrame
) -> Float[Array, "nodes terms rows half"]:
    """The slow part of interference, in single precision: it hardly changes in the course of a fit."""
    model = evaluator.model(theta)
    if not evaluator.interference:
        return jnp.zeros((0, 0, 0, 0), jnp.float32)
    tables = overlap_tables(model, frame)
    return node_overlaps(model, frame, evaluator.lattice, tables).astype(jnp.float32)


@eqx.filter_jit
def kernel_coefficients(
    evaluator: Evaluator,
    theta: Float[Arrayish, " p"],
    block: Block,
    overlaps: Float[Arrayish, "n_nodes n_terms n_rows n_half"],
) -> Float[Array, "rows columns 3"]:
    """The three colours' kernel on the lattice."""
    model = evaluator.model(theta)
    return _coefficients(evaluator, model, block, jnp.asarray(model.spectrum), overlaps)


def _coefficients(
    evaluator: Evaluator,
    model: Diffraction,
    block: Block,
    spectra: Float[Array, "c nodes"],
    overlaps: Float[Arrayish, "n_nodes n_terms n_rows n_half"],
) -> Float[Array, "rows columns c"]:
    transfer = average_transfer(model, block.frame, evaluator.lattice, spectra, block.disc_px)
    if evaluator.interference:
        transfer = transfer + interference_transfer(
            model, block.frame, evaluator.lattice, spectra, overlaps, block.disc_px
        )
    return spline_coefficients(evaluator.lattice, transfer)


def _sampled(
    evaluator: Evaluator,
    block: Block,
    coefficients: Float[Array, "rows columns c"],
    offset_px: Float[Array, "shots 2"],
) -> Float[Array, "shots n c"]:
    """What one unit of light brings to every sample."""
    points = jnp.asarray(block.points) - (offset_px @ jnp.asarray(block.slope).T)[:, None]
    values = sample(evaluator.lattice, coefficients, points.reshape(-1, 2)).reshape(*points.shape[:2], -1)
    return values * jnp.asarray(block.density)[..., None]


@eqx.filter_jit
def normal_equations(
    evaluator: Evaluator,
    theta: Float[Arrayish, " p"],
    block: Block,
    local: Local,
    overlaps: Float[Arrayish, "n_nodes n_terms n_rows n_half"],
) -> Normal:
    """One field position's share of the Gauss-Newton equations, with Huber's weights."""
    theta, offset, colour = jnp.asarray(theta), jnp.asarray(local.offset_px), jnp.asarray(block.colour)
    model = evaluator.model(theta)
    spectra = jnp.asarray(model.spectrum)
    used = overlaps if evaluator.interference else None
    coefficients, by_factor = kernel_slopes(model, block, evaluator.lattice, spectra, used)
    count = spectra.shape[1]
    parts = jnp.concatenate([coefficients, by_factor.reshape(*coefficients.shape[:2], -1)], axis=-1)
    sampled = _sampled(evaluator, block, parts, offset)
    nodes, by_colour = sampled[..., :count], sampled[..., count:].reshape(*sampled.shape[:2], -1, 3)
    unit = jnp.einsum("snj,cj,snc->sn", nodes, spectra, colour)
    slopes = jnp.einsum("snfc,snc->snf", by_colour, colour) @ factors_by_parameter(model, block.frame)
    slopes = slopes.at[..., PUPIL].add(jnp.asarray(block.overlap_slope))
    slopes = slopes.at[..., PITCH].add(jnp.asarray(block.pitch_slope))
    by_move = unit_light_by_move(evaluator, block, offset, coefficients @ spectra.T)
    by_logs = jnp.einsum("snc,cj,snj->sncj", colour, spectra, nodes - unit[..., None])
    flux = jnp.einsum("snc,sc->sn", colour, jnp.asarray(local.flux))
    by_global = flux[..., None] * jnp.concatenate([slopes, by_logs.reshape(*unit.shape, -1)], axis=-1)
    unit = corrected(block, theta, unit)
    by_local = _by_local(block, local, unit, by_move)
    residual = _residual(block, local, unit)
    huber, size = _huber(block, residual)
    return Normal(
        gg=jnp.einsum("snp,sn,snq->pq", by_global, huber, by_global),
        gl=jnp.einsum("snp,sn,snl->spl", by_global, huber, by_local),
        ll=jnp.einsum("snk,sn,snl->skl", by_local, huber, by_local),
        g=jnp.einsum("snp,sn->p", by_global, huber * residual),
        l=jnp.einsum("snl,sn->sl", by_local, huber * residual),
        cost=jnp.sum(jnp.where(size < HUBER, size**2, 2.0 * HUBER * size - HUBER**2)),
    )


@eqx.filter_jit
def local_equations(
    evaluator: Evaluator, block: Block, local: Local, coefficients: Float[Arrayish, "rows columns 3"]
) -> tuple[Float[Array, "shots l l"], Float[Array, "shots l"]]:
    """Normal matrix and right side of every shot's own unknowns for a given kernel."""
    coefficients, offset = jnp.asarray(coefficients), jnp.asarray(local.offset_px)
    unit = unit_light(evaluator, block, offset, coefficients) + jnp.asarray(block.correction)
    by_move = unit_light_by_move(evaluator, block, offset, coefficients)
    by_local = _by_local(block, local, unit, by_move)
    residual = _residual(block, local, unit)
    huber, _ = _huber(block, residual)
    matrix = jnp.einsum("snk,sn,snl->skl", by_local, huber, by_local)
    return matrix, jnp.einsum("snl,sn->sl", by_local, huber * residual)


@eqx.filter_jit
def unit_light(
    evaluator: Evaluator,
    block: Block,
    offset_px: Float[Arrayish, "shots 2"],
    coefficients: Float[Arrayish, "rows columns 3"],
) -> Float[Array, "shots n"]:
    """What one unit of light of its own colour brings to every sample."""
    values = _sampled(evaluator, block, jnp.asarray(coefficients), jnp.asarray(offset_px))
    return jnp.sum(values * block.colour, axis=-1)


@eqx.filter_jit
def unit_light_by_move(
    evaluator: Evaluator,
    block: Block,
    offset_px: Float[Arrayish, "shots 2"],
    coefficients: Float[Arrayish, "rows columns 3"],
) -> Float[Array, "shots n 2"]:
    """Slopes of ``unit_light`` by the place (x, y) of each shot's source, per pixel."""
    return jax.jacfwd(lambda move: unit_light(evaluator, block, jnp.asarray(offset_px) + move, coefficients))(
        jnp.zeros(2)
    )


def _by_local(
    block: Block, local: Local, unit: Float[Array, "shots n"], by_move: Float[Array, "shots n 2"]
) -> Float[Array, "shots n l"]:
    flux = jnp.einsum("snc,sc->sn", block.colour, jnp.asarray(local.flux))
    own = [flux[..., None] * by_move, unit[..., None] * block.colour, jnp.ones_like(unit)[..., None]]
    return jnp.concatenate(own, axis=-1)


@eqx.filter_jit
def unit_light_at(
    evaluator: Evaluator,
    block: Block,
    moves_px: Float[Arrayish, "moves 2"],
    coefficients: Float[Arrayish, "rows columns 3"],
) -> Float[Array, "moves shots n"]:
    """``unit_light`` with all shots moved alike, for each of several moves."""
    shots = jnp.shape(block.rate)[0]

    def one(move: Float[Array, "2"]) -> Float[Array, "shots n"]:
        return unit_light(evaluator, block, jnp.broadcast_to(move, (shots, 2)), coefficients)

    return jax.lax.map(one, jnp.asarray(moves_px))


def _residual(block: Block, local: Local, unit: Float[Array, "shots n"]) -> Float[Array, "shots n"]:
    light = unit * jnp.einsum("snc,sc->sn", block.colour, jnp.asarray(local.flux))
    return jnp.asarray(block.rate) - light - jnp.asarray(local.background)[:, None]


def _huber(block: Block, residual: Float[Array, "shots n"]) -> tuple[Float[Array, "shots n"], Float[Array, "shots n"]]:
    """Weights that let no sample pull harder than one ``HUBER`` sigma off, and residuals in units of sigma."""
    size = jnp.abs(residual) * jnp.sqrt(jnp.asarray(block.weight))
    return jnp.asarray(block.weight) * jnp.minimum(1.0, HUBER / jnp.maximum(size, 1e-12)), size
