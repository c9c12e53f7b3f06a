"""The samples of each field position, the light that a model expects of them, and its normal equations.

Own parameters of a shot are (x, y) in px from the place first assumed, light per colour and background in e-/s.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.robust import Huber
from udccal.fitting.psf.data import Shots
from udccal.fitting.psf.kernel import PITCH, PUPIL, Evaluator, factor_jacobian, kernel_jacobian
from udccal.fitting.psf.start import PsfRules
from udccal.models.arrays import Arrayish
from udccal.models.diffraction import LocalFrame, local_frame
from udccal.models.geometry import Geometry
from udccal.models.lattice import sample
from udccal.models.psf import lattice_points

OWN: Final = 6
# Overlaps of the pupil's footprint change with these parameters.
IN_OVERLAPS: Final = np.array([PITCH, PUPIL])
_HUBER: Final = Huber().sigma
# Places tried for an LED about its brightest spot, by how many samples, and how far off a model may be there.
_GRID_PX: Final = np.linspace(-1.25, 1.25, 11)
_CORE_SAMPLES: Final = 117
_TRUST: Final = 0.1
_BOUND: Final = 10.0
_BY_SAMPLE: Final = ("points", "density", "colour", "rate", "known", "noise_per_rate", "weight", "correction")


@final
class Block(eqx.Module):
    """The chosen samples of all shots of one field position, padded to one size with samples of weight 0.

    Attributes:
        points, density: samples on the lattice about the mean place; see ``models.psf.lattice_points``.
        slope: lattice units per pixel, to move a source.
        begun_px: (x, y) of the shots from the mean place, as first assumed.
        colour: which of three colours a sample has (one-hot).
        known: inverse variance of a sample as it was measured, 0 where there is none.
        noise_per_rate: by how much that variance grows with the light, in (e-/s)^2 per e-/s.
        weight: inverse variance that the fit goes by; see ``psf.weights``.
        correction: per unit of light of a sample's colour, what a shot has more because the pupil's footprint lies
            elsewhere on the rows than at the mean place.
        by_overlaps: by how much interference changes with the pitch and with the pupil because overlaps do, per mm and
            unit of light. overlaps_at: those (mm) that ``overlaps``, of ``kernel.overlaps_of``, are of.
        index: which shots these are, -1 for padding.
    """

    frame: LocalFrame
    points: Float[Arrayish, "shots n 2"]
    density: Float[Arrayish, "shots n"]
    slope: Float[Arrayish, "2 2"]
    begun_px: Float[Arrayish, "shots 2"]
    colour: Float[Arrayish, "shots n 3"]
    rate: Float[Arrayish, "shots n"]
    known: Float[Arrayish, "shots n"]
    noise_per_rate: Float[Arrayish, "shots n"]
    weight: Float[Arrayish, "shots n"]
    correction: Float[Arrayish, "shots n"]
    by_overlaps: Float[Arrayish, "shots n 2"]
    overlaps_at: Float[Arrayish, "2"]
    overlaps: Float[Arrayish, "nodes terms rows half"]
    disc_px: Float[Arrayish, ""]
    index: Int[Arrayish, " shots"]


def choose_samples(shots: Shots, rules: PsfRules, far_share: float) -> Bool[np.ndarray, "shots rows columns"]:
    """All samples about the peak and a seeded draw of the others in the window of the fit, as many in every shot."""
    rng = np.random.default_rng(2)
    x, y = np.moveaxis(np.abs(shots.offsets()), -1, 0)
    inside = (x <= rules.close_px[1]) & (y <= rules.close_px[0])
    near = (x <= rules.peak_half_px[1]) & (y <= rules.peak_half_px[0]) & inside
    far = np.flatnonzero((inside & ~near).ravel())
    chosen = np.tile(near.ravel(), (shots.count, 1))
    for row in chosen:
        row[rng.choice(far, round(len(far) * far_share), replace=False)] = True
    return chosen.reshape(shots.rate.shape)


def stands_for(shots: Shots, rules: PsfRules) -> Float[np.ndarray, "shots n"]:
    """How many samples of its picture each chosen one stands for: those away from the peak were drawn."""
    chosen, near = (choose_samples(shots, rules, part) for part in (rules.far_share, 0.0))
    return np.where(near[chosen].reshape(shots.count, -1), 1.0, 1.0 / rules.far_share)


_frame = eqx.filter_jit(local_frame)
_points = eqx.filter_jit(lattice_points)


def blocks(shots: Shots, geometry: Geometry, chosen: Bool[np.ndarray, "shots rows columns"]) -> tuple[Block, ...]:
    """Chosen samples by field position, all blocks of one shape; overlaps are yet to come."""
    groups = [np.flatnonzero(shots.position == g) for g in range(shots.positions)]
    size = max(len(g) for g in groups), int(chosen.sum(axis=(1, 2)).max())
    return tuple(_block(shots, geometry, chosen, group, size) for group in groups)


def _block(
    shots: Shots, geometry: Geometry, chosen: np.ndarray, group: Int[np.ndarray, " k"], size: tuple[int, int]
) -> Block:
    place = shots.centre_px[group].mean(axis=0)
    frame = _frame(geometry, place)
    offsets, colour, begun = np.zeros((*size, 2)), np.zeros((*size, 3)), np.zeros((size[0], 2))
    rate, weight, slope = (np.zeros(size) for _ in range(3))
    for i, shot in enumerate(group):
        mask = chosen[shot]
        n = int(mask.sum())
        offsets[i, :n] = shots.offsets()[mask] + shots.origin_px[shot] - place
        rate[i, :n], weight[i, :n] = shots.rate[shot][mask], shots.weight[shot][mask]
        slope[i, :n] = shots.noise_per_rate[shot][mask]
        colour[i, :n] = np.eye(3)[shots.channel[shot][mask]]
    begun[: len(group)] = shots.centre_px[group] - place
    together = np.concatenate([offsets.reshape(-1, 2), begun])
    points, density = (np.asarray(part) for part in _points(geometry, frame, place, together))
    moved = points[-size[0] :]
    scale = jnp.abs(jnp.diagonal(frame.jacobian))
    return Block(
        frame=frame,
        points=points[: -size[0]].reshape(*size, 2) - moved[:, None],
        density=density[: -size[0]].reshape(size),
        slope=frame.jacobian / scale[:, None],
        begun_px=begun,
        colour=colour,
        rate=rate,
        known=weight,
        noise_per_rate=slope,
        weight=weight,
        correction=np.zeros(size),
        by_overlaps=np.zeros((*size, 2)),
        overlaps_at=np.zeros(2),
        overlaps=np.zeros((0, 0, 0, 0), dtype=np.float32),
        disc_px=np.asarray(shots.disc_px[group].mean()),
        index=np.pad(group, (0, size[0] - len(group)), constant_values=-1),
    )


@eqx.filter_jit
def unit_light(
    evaluator: Evaluator,
    block: Block,
    offset_px: Float[Arrayish, "shots 2"],
    coefficients: Float[Arrayish, "rows columns 3"],
) -> Float[Array, "shots n"]:
    """What one unit of light of its own colour brings to every sample, corrections left out."""
    values = _sampled(evaluator, block, jnp.asarray(coefficients), jnp.asarray(offset_px))
    return jnp.sum(values * block.colour, axis=-1)


def corrected(block: Block, theta: Float[Arrayish, " p"], unit: Float[Arrayish, "shots n"]) -> Float[Array, "shots n"]:
    """Light per unit with what the lattice's kernel at the mean place, and with fixed overlaps, does not have."""
    off = jnp.asarray(theta)[IN_OVERLAPS] - jnp.asarray(block.overlaps_at)
    return jnp.asarray(unit) + jnp.asarray(block.correction) + jnp.asarray(block.by_overlaps) @ off


@final
class Sums(NamedTuple):
    """Normal equations of one position, in the order of ``engine.least_squares.Blocks``, samples left out."""

    cost: Float[Arrayish, ""]
    shared: Float[Arrayish, "p p"]
    right: Float[Arrayish, " p"]
    own: Float[Arrayish, "shots l l"]
    own_right: Float[Arrayish, "shots l"]
    cross: Float[Arrayish, "shots p l"]


@eqx.filter_jit
def normal_equations(
    evaluator: Evaluator, theta: Float[Arrayish, " p"], block: Block, own: Float[Arrayish, "shots l"]
) -> Sums:
    """One field position's share of the Gauss-Newton equations, with Huber's weights."""
    theta, own, colour = jnp.asarray(theta), jnp.asarray(own), jnp.asarray(block.colour)
    model = evaluator.model(theta)
    spectra = jnp.asarray(model.spectrum)
    coefficients, by_factor = kernel_jacobian(evaluator, model, block.frame, block.disc_px, block.overlaps)
    count = spectra.shape[1]
    parts = jnp.concatenate([coefficients, by_factor.reshape(*coefficients.shape[:2], -1)], axis=-1)
    sampled = _sampled(evaluator, block, parts, own[:, :2])
    nodes, by_colour = sampled[..., :count], sampled[..., count:].reshape(*sampled.shape[:2], -1, 3)
    unit = jnp.einsum("snj,cj,snc->sn", nodes, spectra, colour)
    by_head = jnp.einsum("snfc,snc->snf", by_colour, colour) @ factor_jacobian(model, block.frame)
    by_head = by_head.at[..., IN_OVERLAPS].add(jnp.asarray(block.by_overlaps))
    by_move = _by_move(evaluator, block, own[:, :2], coefficients @ spectra.T)
    by_logs = jnp.einsum("snc,cj,snj->sncj", colour, spectra, nodes - unit[..., None])
    by_theta = jnp.concatenate([by_head, by_logs.reshape(*unit.shape, -1)], axis=-1)
    by_theta = _flux(block, own)[..., None] * by_theta
    by_own, residual = _own_jacobian(block, own, corrected(block, theta, unit), by_move)
    huber, size = _huber(block, residual)
    return Sums(
        cost=jnp.sum(jnp.where(size < _HUBER, size**2, 2.0 * _HUBER * size - _HUBER**2)),
        shared=jnp.einsum("snp,sn,snq->pq", by_theta, huber, by_theta),
        right=jnp.einsum("snp,sn->p", by_theta, huber * residual),
        own=jnp.einsum("snk,sn,snl->skl", by_own, huber, by_own),
        own_right=jnp.einsum("snl,sn->sl", by_own, huber * residual),
        cross=jnp.einsum("snp,sn,snl->spl", by_theta, huber, by_own),
    )


@eqx.filter_jit
def own_equations(
    evaluator: Evaluator, block: Block, own: Float[Arrayish, "shots l"], coefficients: Float[Arrayish, "rows columns 3"]
) -> tuple[Float[Array, "shots l l"], Float[Array, "shots l"]]:
    """Normal matrix and right side of every shot's own parameters for a given kernel."""
    coefficients, own = jnp.asarray(coefficients), jnp.asarray(own)
    unit = unit_light(evaluator, block, own[:, :2], coefficients) + jnp.asarray(block.correction)
    by_own, residual = _own_jacobian(block, own, unit, _by_move(evaluator, block, own[:, :2], coefficients))
    huber, _ = _huber(block, residual)
    matrix = jnp.einsum("snk,sn,snl->skl", by_own, huber, by_own)
    return matrix, jnp.einsum("snl,sn->sl", by_own, huber * residual)


def start_own(
    evaluator: Evaluator, block: Block, coefficients: Float[np.ndarray, "rows columns 3"]
) -> Float[np.ndarray, "shots l"]:
    """Start of every shot's own parameters: the best of a grid of places, light and background by least squares.

    A centroid will not do: neighbouring diffraction orders are half as bright as the middle one, and the mosaic samples
    each colour unevenly, so it can be off by a pixel; a descent from there ends on a neighbouring order.
    """
    core = np.argsort((np.asarray(block.points) ** 2).sum(axis=-1), axis=1, kind="stable")[:, :_CORE_SAMPLES]
    rows = np.arange(len(core))[:, None]
    taken = {name: np.asarray(getattr(block, name))[rows, core] for name in _BY_SAMPLE}
    near = replace(block, by_overlaps=np.zeros((*core.shape, 2)), **taken)
    moves = np.stack(np.meshgrid(_GRID_PX, _GRID_PX), axis=-1).reshape(-1, 2)
    tried = np.asarray(_unit_light_at(evaluator, near, moves, coefficients))
    offset = np.stack([moves[np.argmin(_linear(near, tried[:, shot], shot)[1])] for shot in range(len(core))])
    unit = np.asarray(unit_light(evaluator, block, offset, coefficients))
    linear = np.stack([_linear(block, unit[None, shot], shot)[0][0] for shot in range(len(core))])
    return np.concatenate([offset, linear], axis=1)


@eqx.filter_jit
def _unit_light_at(
    evaluator: Evaluator, block: Block, moves_px: Float[Arrayish, "moves 2"], coefficients: Float[Arrayish, "r c 3"]
) -> Float[Array, "moves shots n"]:
    """``unit_light`` with all shots moved alike, for each of several moves."""
    still = jnp.zeros((jnp.shape(block.rate)[0], 2))
    return jax.lax.map(lambda move: unit_light(evaluator, block, still + move, coefficients), jnp.asarray(moves_px))


def _linear(
    block: Block, units: Float[np.ndarray, "moves n"], shot: int
) -> tuple[Float[np.ndarray, "moves 4"], Float[np.ndarray, " moves"]]:
    """Light per colour and background of one shot for each of several expectations, and the cost that remains."""
    rate, weight = np.asarray(block.rate)[shot], np.asarray(block.weight)[shot]
    # Far from the solution the model is no better than a part of the signal.
    variance = 1.0 / np.where(weight > 0, weight, 1.0) + (_TRUST * np.maximum(rate, 0.0)) ** 2
    root = np.where(weight > 0, 1.0 / np.sqrt(variance), 0.0)
    design = np.concatenate([units[..., None] * np.asarray(block.colour)[shot], np.ones((*units.shape, 1))], axis=-1)
    design = design * root[:, None]
    inverse = scaled_inverse(np.einsum("mnk,mnl->mkl", design, design))
    solution = np.einsum("mkl,mnl,n->mk", inverse, design, rate * root, optimize=True)
    # Without the bound a place where nothing is expected would fit a dark neighbourhood best.
    left = np.minimum(np.abs(rate * root - np.einsum("mnk,mk->mn", design, solution)), _BOUND)
    return solution, (left**2).sum(axis=-1)


def _sampled(
    evaluator: Evaluator, block: Block, coefficients: Float[Array, "rows columns c"], offset_px: Float[Array, "shots 2"]
) -> Float[Array, "shots n c"]:
    """What one unit of light brings to every sample."""
    points = jnp.asarray(block.points) - (offset_px @ jnp.asarray(block.slope).T)[:, None]
    values = sample(evaluator.lattice, coefficients, points.reshape(-1, 2)).reshape(*points.shape[:2], -1)
    return values * jnp.asarray(block.density)[..., None]


def _by_move(
    evaluator: Evaluator, block: Block, offset_px: Float[Array, "shots 2"], coefficients: Float[Array, "r c 3"]
) -> Float[Array, "shots n 2"]:
    """Derivatives of ``unit_light`` by the place (x, y) of each shot's source, per pixel."""
    return jax.jacfwd(lambda move: unit_light(evaluator, block, offset_px + move, coefficients))(jnp.zeros(2))


def _flux(block: Block, own: Float[Array, "shots l"]) -> Float[Array, "shots n"]:
    return jnp.einsum("snc,sc->sn", block.colour, own[:, 2:5])


def _own_jacobian(
    block: Block, own: Float[Array, "shots l"], unit: Float[Array, "shots n"], by_move: Float[Array, "shots n 2"]
) -> tuple[Float[Array, "shots n l"], Float[Array, "shots n"]]:
    """Derivatives of the light by each shot's own parameters, and data less expectation."""
    flux = _flux(block, own)
    by_own = [flux[..., None] * by_move, unit[..., None] * block.colour, jnp.ones_like(unit)[..., None]]
    return jnp.concatenate(by_own, axis=-1), jnp.asarray(block.rate) - unit * flux - own[:, 5:]


def _huber(block: Block, residual: Float[Array, "shots n"]) -> tuple[Float[Array, "shots n"], Float[Array, "shots n"]]:
    """Weights that let no sample pull harder than one ``_HUBER`` sigma off, and residuals in units of sigma."""
    size = jnp.abs(residual) * jnp.sqrt(jnp.asarray(block.weight))
    return jnp.asarray(block.weight) * jnp.minimum(1.0, _HUBER / jnp.maximum(size, 1e-12)), size
