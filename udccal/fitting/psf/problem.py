"""The light that diffraction brings to samples, its normal equations, and both as a problem for the engine's solver.

Own parameters of a shot are (x, y) in px from the place first assumed, light per colour and background in e-/s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.special import softmax

from udccal.fitting.engine.gaussian import Prior, scaled_inverse
from udccal.fitting.engine.least_squares import Blocks, Step
from udccal.fitting.psf.kernel import (
    HEAD,
    PITCH,
    PUPIL,
    Evaluator,
    factor_jacobian,
    interference_coefficients,
    kernel_coefficients,
    kernel_jacobian,
    overlaps_of,
)
from udccal.fitting.psf.samples import Samples
from udccal.fitting.psf.start import HUBER
from udccal.models.arrays import Arrayish
from udccal.models.interference import footprint_place, strengths
from udccal.models.lattice import sample

OWN: Final = 6
# Overlaps of the pupil's footprint change with these parameters.
_IN_OVERLAPS: Final = np.array([PITCH, PUPIL])


@final
@dataclass(frozen=True)
class Place:
    """Where a descent is: the shared parameters of diffraction, and those of every shot."""

    theta: Float[np.ndarray, " p"]
    own: Float[np.ndarray, "positions shots l"]


@final
@dataclass(frozen=True)
class DiffractionProblem:
    """Diffraction for the engine's solver; the groups of its equations are the shots, position after position.

    Interference changes with where the pupil's footprint lies and with its overlaps, which are slow to follow: it is
    set up about one place, with what it needs to be right around it.
    """

    samples: Samples
    evaluator: Evaluator
    prior: Prior
    name: str = "psf"

    @property
    def used(self) -> int:
        """How many samples count."""
        return int((np.asarray(self.samples.weight) > 0).sum())

    @property
    def unknowns(self) -> int:
        """How many numbers are estimated, those of each shot included."""
        return self.prior.mean.size + OWN * int((np.asarray(self.samples.index) >= 0).sum())

    def by_position(self, place: Place) -> list[Blocks]:
        """Each position's part of the equations, without the prior."""
        made = normal_equations(self.evaluator, place.theta, self.samples, place.own)
        cost, *parts = (np.asarray(part) for part in made)
        counts = (np.asarray(self.samples.weight) > 0).sum(axis=(1, 2))
        return [Blocks(float(cost[i]), int(n), *(part[i] for part in parts)) for i, n in enumerate(counts)]

    def equations_at(self, place: Place) -> Blocks:
        """Cost and normal equations, the prior's included."""
        made = self.by_position(place)
        own = (np.concatenate([getattr(one, part) for one in made]) for part in ("own", "own_right", "cross"))
        shared, right = np.sum([one.shared for one in made], axis=0), np.sum([one.right for one in made], axis=0)
        whole = Blocks(sum(one.cost for one in made), self.used, shared, right, *own)
        return whole.with_prior(self.prior, place.theta)

    def moved(self, place: Place, step: Step) -> Place:
        """The place after a step."""
        return Place(stepped(place.theta, step.shared), moved_own(place.own, step.own.reshape(place.own.shape)))

    def light_at(self, place: Place) -> Float[np.ndarray, "positions shots n"]:
        """What samples hold under the model, in e-/s, without background."""
        return np.asarray(light_of(self.evaluator, place.theta, self.samples, place.own))

    def errors(self, place: Place, light: Float[np.ndarray, "positions shots n"]) -> Float[np.ndarray, "p s n"]:
        """Data less expectation in units of sigma, 0 where no sample counts; ``light`` of that place."""
        samples = self.samples
        return np.asarray((samples.rate - light - place.own[..., 5:]) * np.sqrt(np.asarray(samples.weight)))

    def with_overlaps(self, theta: Float[np.ndarray, " p"]) -> DiffractionProblem:
        """With the overlaps of ``theta``: what interference depends on hardly changes in a descent."""
        overlaps = np.asarray(overlaps_by_position(self.evaluator, theta, self.samples))
        return replace(self, samples=replace(self.samples, overlaps=overlaps))

    def about(self, place: Place) -> DiffractionProblem:
        """With interference set up about a place."""
        if not self.evaluator.interference:
            return self.with_overlaps(place.theta)
        return replace(self, samples=with_interference(self.evaluator, place.theta, self.samples, place.own[..., :2]))


def stepped(theta: Float[np.ndarray, " p"], step: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Parameters after a step; light grows by what the step says, not by that number's exponential."""
    spectra = softmax(theta[HEAD:].reshape(3, -1), axis=1)
    logs = step[HEAD:].reshape(3, -1)
    mean = np.sum(spectra * logs, axis=1, keepdims=True)
    grown = logs - mean
    grown = np.where(grown > 0, np.log1p(np.maximum(grown, 0.0)), grown)
    return theta + np.concatenate([step[:HEAD], (mean + grown).ravel()])


def moved_own(own: Float[np.ndarray, "*k l"], step: Float[np.ndarray, "*k l"]) -> Float[np.ndarray, "*k l"]:
    """Places of LEDs move by no more than half a pixel in a step."""
    return own + np.concatenate([np.clip(step[..., :2], -0.5, 0.5), step[..., 2:]], axis=-1)


@eqx.filter_jit
def overlaps_by_position(
    evaluator: Evaluator, theta: Float[Arrayish, " p"], samples: Samples
) -> Float[Array, "positions nodes terms rows half"]:
    """See ``kernel.overlaps_of``."""
    return jax.lax.map(lambda frame: overlaps_of(evaluator, theta, frame), samples.frame)


@eqx.filter_jit
def coefficients_of(
    evaluator: Evaluator, theta: Float[Arrayish, " p"], samples: Samples
) -> Float[Array, "positions y x 3"]:
    """Of the kernel at every position."""
    return jax.lax.map(lambda one: _coefficients(evaluator, jnp.asarray(theta), one), samples)


def _coefficients(evaluator: Evaluator, theta: Float[Array, " p"], one: Samples) -> Float[Array, "y x 3"]:
    overlaps = one.overlaps if np.shape(one.overlaps)[-1] else overlaps_of(evaluator, theta, one.frame)
    return kernel_coefficients(evaluator, theta, one.frame, one.disc_px, overlaps)


@eqx.filter_jit
def light_of(
    evaluator: Evaluator, theta: Float[Arrayish, " p"], samples: Samples, own: Float[Arrayish, "positions shots l"]
) -> Float[Array, "positions shots n"]:
    """What samples hold under the model, in e-/s, without background."""
    theta = jnp.asarray(theta)

    def one(pair: tuple[Samples, Array]) -> Float[Array, "shots n"]:
        here, mine = pair
        unit = unit_light(evaluator, here, mine[:, :2], _coefficients(evaluator, theta, here))
        return _corrected(here, theta, unit) * _flux(here, mine)

    return jax.lax.map(one, (samples, jnp.asarray(own)))


@eqx.filter_jit
def unit_light(
    evaluator: Evaluator, one: Samples, offset_px: Float[Arrayish, "shots 2"], coefficients: Float[Arrayish, "y x 3"]
) -> Float[Array, "shots n"]:
    """What one unit of light of its own colour brings to every sample of one position, corrections left out."""
    values = _sampled(evaluator, one, jnp.asarray(coefficients), jnp.asarray(offset_px))
    return jnp.sum(values * one.colour, axis=-1)


def _corrected(one: Samples, theta: Float[Array, " p"], unit: Float[Array, "shots n"]) -> Float[Array, "shots n"]:
    """Light per unit with what the lattice's kernel at the mean place, and with fixed overlaps, does not have."""
    return unit + one.correction + one.by_overlaps @ (theta[_IN_OVERLAPS] - one.overlaps_at)


def _flux(one: Samples, own: Float[Array, "shots l"]) -> Float[Array, "shots n"]:
    return jnp.einsum("snc,sc->sn", one.colour, own[:, 2:5])


def _sampled(
    evaluator: Evaluator, one: Samples, coefficients: Float[Array, "y x c"], offset_px: Float[Array, "shots 2"]
) -> Float[Array, "shots n c"]:
    """What one unit of light brings to every sample."""
    points = one.points - (offset_px @ one.slope.T)[:, None]
    values = sample(evaluator.lattice, coefficients, points.reshape(-1, 2)).reshape(*points.shape[:2], -1)
    return values * one.density[..., None]


@eqx.filter_jit
def with_interference(
    evaluator: Evaluator,
    theta: Float[Arrayish, " p"],
    samples: Samples,
    offset_px: Float[Arrayish, "positions shots 2"],
) -> Samples:
    """With overlaps of ``theta``, how they change with it, and each shot's own place on the rows."""
    theta = jnp.asarray(theta)

    def one(pair: tuple[Samples, Array]) -> tuple[Array, Array, Array]:
        here, offset = pair
        frame, model = here.frame, evaluator.model(theta)
        overlaps, place = overlaps_of(evaluator, theta, frame), footprint_place(model, frame)
        coefficients = interference_coefficients(evaluator, model, frame, here.disc_px)
        strength, by_overlaps = strengths(model, place), []
        # Overlaps are in single precision: by such steps, in mm, their difference is not. Over steps ten times as long
        # derivatives bend by some percent.
        for number, step_mm in ((PITCH, 0.0002), (PUPIL, 0.001)):
            change = overlaps_of(evaluator, theta.at[number].add(step_mm), frame) - overlaps
            by_overlaps.append(unit_light(evaluator, here, offset, coefficients(strength, change)) / step_mm)
        slope = frame.direction[:2] / frame.direction[2]
        tangent = (jnp.eye(2) + jnp.outer(slope, slope)) / frame.direction[2]
        along = model.standoff_per_pitch * (here.begun_px + offset) @ (tangent @ frame.jacobian).T

        def elsewhere(move: Float[Array, "2"]) -> Float[Array, "shots n"]:
            stronger = strengths(model, place + move) - strength
            return unit_light(evaluator, here, offset, coefficients(stronger, overlaps))

        of_shots = jnp.diagonal(jax.lax.map(elsewhere, along), axis1=0, axis2=1).T
        return overlaps, of_shots, jnp.stack(by_overlaps, axis=-1)

    overlaps, correction, by_overlaps = jax.lax.map(one, (samples, jnp.asarray(offset_px)))
    at = jnp.tile(theta[_IN_OVERLAPS], (len(overlaps), 1))
    return replace(samples, overlaps=overlaps, correction=correction, by_overlaps=by_overlaps, overlaps_at=at)


@eqx.filter_jit
def normal_equations(
    evaluator: Evaluator, theta: Float[Arrayish, " p"], samples: Samples, own: Float[Arrayish, "positions shots l"]
) -> tuple[Array, ...]:
    """Each position's part of the Gauss-Newton equations, with Huber's weights.

    In the order of ``engine.least_squares.Blocks``, the number of samples left out.
    """
    theta = jnp.asarray(theta)
    return jax.lax.map(lambda pair: _normal_equations(evaluator, theta, *pair), (samples, jnp.asarray(own)))


def _normal_equations(
    evaluator: Evaluator, theta: Float[Array, " p"], one: Samples, own: Float[Array, "shots l"]
) -> tuple[Array, ...]:
    model, colour = evaluator.model(theta), one.colour
    spectra = jnp.asarray(model.spectrum)
    coefficients, by_factor = kernel_jacobian(evaluator, model, one.frame, one.disc_px, one.overlaps)
    count = spectra.shape[1]
    parts = jnp.concatenate([coefficients, by_factor.reshape(*coefficients.shape[:2], -1)], axis=-1)
    sampled = _sampled(evaluator, one, parts, own[:, :2])
    nodes, by_colour = sampled[..., :count], sampled[..., count:].reshape(*sampled.shape[:2], -1, 3)
    unit = jnp.einsum("snj,cj,snc->sn", nodes, spectra, colour)
    by_head = jnp.einsum("snfc,snc->snf", by_colour, colour) @ factor_jacobian(evaluator, theta, one.frame)
    by_head = by_head.at[..., _IN_OVERLAPS].add(one.by_overlaps)
    by_logs = jnp.einsum("snc,cj,snj->sncj", colour, spectra, nodes - unit[..., None])
    by_theta = jnp.concatenate([by_head, by_logs.reshape(*unit.shape, -1)], axis=-1) * _flux(one, own)[..., None]
    unit = _corrected(one, theta, unit)
    by_own, residual, huber = _own_jacobian(evaluator, one, own, unit, coefficients @ spectra.T)
    size = jnp.abs(residual) * jnp.sqrt(one.weight)
    return (
        jnp.sum(jnp.where(size < HUBER.sigma, size**2, 2.0 * HUBER.sigma * size - HUBER.sigma**2)),
        jnp.einsum("snp,sn,snq->pq", by_theta, huber, by_theta),
        jnp.einsum("snp,sn->p", by_theta, huber * residual),
        jnp.einsum("snk,sn,snl->skl", by_own, huber, by_own),
        jnp.einsum("snl,sn->sl", by_own, huber * residual),
        jnp.einsum("snp,sn,snl->spl", by_theta, huber, by_own),
    )


@eqx.filter_jit
def own_equations(
    evaluator: Evaluator,
    samples: Samples,
    own: Float[Arrayish, "positions shots l"],
    coefficients: Float[Arrayish, "positions y x 3"],
) -> tuple[Float[Array, "positions shots l l"], Float[Array, "positions shots l"], Float[Array, "positions shots n"]]:
    """Normal matrix and right side of every shot's own parameters for given kernels, and light per unit."""

    def one(group: tuple[Samples, Array, Array]) -> tuple[Array, Array, Array]:
        here, mine, kernel = group
        unit = unit_light(evaluator, here, mine[:, :2], kernel)
        by_own, residual, huber = _own_jacobian(evaluator, here, mine, unit, kernel)
        matrix = jnp.einsum("snk,sn,snl->skl", by_own, huber, by_own)
        return matrix, jnp.einsum("snl,sn->sl", by_own, huber * residual), unit

    return jax.lax.map(one, (samples, jnp.asarray(own), jnp.asarray(coefficients)))


def _own_jacobian(
    evaluator: Evaluator,
    one: Samples,
    own: Float[Array, "shots l"],
    unit: Float[Array, "shots n"],
    coefficients: Float[Array, "y x 3"],
) -> tuple[Float[Array, "shots n l"], Float[Array, "shots n"], Float[Array, "shots n"]]:
    """Derivatives of the light by each shot's own parameters, data less expectation, and Huber's weights."""
    by_move = jax.jacfwd(lambda move: unit_light(evaluator, one, own[:, :2] + move, coefficients))(jnp.zeros(2))
    flux = _flux(one, own)
    by_own = [flux[..., None] * by_move, unit[..., None] * one.colour, jnp.ones_like(unit)[..., None]]
    residual = one.rate - unit * flux - own[:, 5:]
    size = jnp.abs(residual) * jnp.sqrt(one.weight)
    huber = one.weight * jnp.minimum(1.0, HUBER.sigma / jnp.maximum(size, 1e-12))
    return jnp.concatenate(by_own, axis=-1), residual, huber


def start_own(
    evaluator: Evaluator, samples: Samples, coefficients: Float[Arrayish, "positions y x 3"]
) -> Float[np.ndarray, "positions shots l"]:
    """Start of every shot's own parameters: the best of a grid of places, light and background by least squares.

    A centroid will not do: neighbouring diffraction orders are half as bright as the middle one, and the mosaic samples
    each colour unevenly, so it can be off by a pixel; a descent from there ends on a neighbouring order.
    """
    # Places are compared on the samples about the brightest spot; 117 of them are enough.
    core = np.argsort((np.asarray(samples.points) ** 2).sum(axis=-1), axis=-1, kind="stable")[..., :117]
    by_sample = (
        "points",
        "density",
        "colour",
        "rate",
        "known",
        "noise_per_rate",
        "weight",
        "correction",
        "by_overlaps",
    )
    near = replace(samples, **{name: _taken(np.asarray(getattr(samples, name)), core) for name in by_sample})
    moves = np.stack(np.meshgrid(*2 * (np.linspace(-1.25, 1.25, 11),)), axis=-1).reshape(-1, 2)
    every = np.broadcast_to(moves[None, :, None], (len(core), len(moves), core.shape[1], 2))
    _, cost = _linear(near, np.asarray(_unit_lights(evaluator, near, every, coefficients)))
    offset = moves[cost.argmin(axis=1)]
    linear, _ = _linear(samples, np.asarray(_unit_lights(evaluator, samples, offset[:, None], coefficients)))
    return np.concatenate([offset, linear[:, 0]], axis=-1)


def _taken(values: np.ndarray, core: Int[np.ndarray, "positions shots few"]) -> np.ndarray:
    return np.take_along_axis(values, core.reshape(*core.shape, *(1,) * (values.ndim - core.ndim)), axis=2)


@eqx.filter_jit
def _unit_lights(
    evaluator: Evaluator,
    samples: Samples,
    offsets_px: Float[Arrayish, "positions moves shots 2"],
    coefficients: Float[Arrayish, "positions y x 3"],
) -> Float[Array, "positions moves shots n"]:
    """``unit_light`` for each of several moves of all shots."""

    def one(group: tuple[Samples, Array, Array]) -> Float[Array, "moves shots n"]:
        here, offsets, kernel = group
        return jax.lax.map(lambda offset: unit_light(evaluator, here, offset, kernel), offsets)

    return jax.lax.map(one, (samples, jnp.asarray(offsets_px), jnp.asarray(coefficients)))


def _linear(
    samples: Samples, units: Float[np.ndarray, "positions moves shots n"]
) -> tuple[Float[np.ndarray, "positions moves shots 4"], Float[np.ndarray, "positions moves shots"]]:
    """Light per colour and background of the shots for each of several expectations, and the cost that remains."""
    rate, weight, colour = (np.asarray(part)[:, None] for part in (samples.rate, samples.weight, samples.colour))
    # Far from the solution the model is no better than a tenth of the signal.
    variance = 1.0 / np.where(weight > 0, weight, 1.0) + (0.1 * np.maximum(rate, 0.0)) ** 2
    root = np.where(weight > 0, 1.0 / np.sqrt(variance), 0.0)
    design = np.concatenate([units[..., None] * colour, np.ones((*units.shape, 1))], axis=-1) * root[..., None]
    data, across = (rate * root)[..., None], np.swapaxes(design, -1, -2)
    solution = scaled_inverse(across @ design) @ (across @ data)
    # Without the bound a place where nothing is expected would fit a dark neighbourhood best.
    left = np.minimum(np.abs(data - design @ solution), 10.0)
    return solution[..., 0], (left[..., 0] ** 2).sum(axis=-1)
