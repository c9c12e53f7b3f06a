"""The light that diffraction brings to samples, its normal equations, and both as a problem for the engine's solver.

Own parameters of a shot are (x, y) in px from the first assumed place, light per colour and background in e-/s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import softmax

from udccal.fitting.engine.gaussian import Prior, scaled_inverse
from udccal.fitting.engine.least_squares import Blocks, Step
from udccal.fitting.psf.data import HUBER, Crops, Shots
from udccal.fitting.psf.kernel import (
    HEAD,
    PITCH,
    PUPIL,
    Evaluator,
    factor_jacobian,
    fit_lattice,
    interference_coefficients,
    kernel_coefficients,
    kernel_jacobian,
    overlaps_of,
)
from udccal.fitting.psf.samples import (
    OWN,
    Light,
    Lights,
    Own,
    Owns,
    Samples,
    Theta,
    flux_of,
    gather,
    own_equations,
    own_jacobian,
    sampled,
    start_own,
    unit_light,
    weighed,
)
from udccal.models.arrays import Arrayish
from udccal.models.geometry import Geometry
from udccal.models.interference import footprint_place, strengths

# Overlaps of the pupil's footprint change with these parameters.
_IN_OVERLAPS: Final = np.array([PITCH, PUPIL])


@final
@dataclass(frozen=True)
class Place:
    """A descent's current parameters: those of diffraction, which are shared, and those of every shot."""

    theta: Float[np.ndarray, " p"]
    own: Owns


@final
@dataclass(frozen=True)
class DiffractionProblem:
    """Diffraction for the engine's solver; the groups of its equations are the shots, position after position.

    Interference depends on the place of the pupil's footprint and on its overlaps, which take long to compute. It is
    therefore set up about one place, with its changes around that place to first order.
    """

    samples: Samples
    evaluator: Evaluator
    prior: Prior
    name: str = "psf"

    @property
    def used(self) -> int:
        """Number of samples that are used."""
        return int((np.asarray(self.samples.weight) > 0).sum())

    @property
    def unknowns(self) -> int:
        """Number of parameters, those of each shot included."""
        return self.prior.mean.size + OWN * int((np.asarray(self.samples.index) >= 0).sum())

    def by_position(self, place: Place) -> list[Blocks]:
        """Return each position's part of the equations, without the prior."""
        made = normal_equations(self.evaluator, place.theta, self.samples, place.own)
        cost, *parts = (np.asarray(part) for part in made)
        counts = (np.asarray(self.samples.weight) > 0).sum(axis=(1, 2))
        return [Blocks(float(cost[i]), int(n), *(part[i] for part in parts)) for i, n in enumerate(counts)]

    def equations_at(self, place: Place) -> Blocks:
        """Return cost and normal equations, with the prior's."""
        made = self.by_position(place)
        own = (np.concatenate([getattr(one, part) for one in made]) for part in ("own", "own_right", "cross"))
        shared, right = np.sum([one.shared for one in made], axis=0), np.sum([one.right for one in made], axis=0)
        whole = Blocks(sum(one.cost for one in made), self.used, shared, right, *own)
        return whole.with_prior(self.prior, place.theta)

    def moved(self, place: Place, step: Step) -> Place:
        """Return the place after a step."""
        return Place(stepped(place.theta, step.shared), moved_own(place.own, step.own.reshape(place.own.shape)))

    def light_at(self, place: Place) -> Lights:
        """Return the samples' light under the model, in e-/s, without background."""
        return np.asarray(light_of(self.evaluator, place.theta, self.samples, place.own))

    def errors(self, place: Place, light: Lights) -> Lights:
        """Return data less expectation in units of sigma, 0 for unused samples; ``light`` is of that place."""
        samples = self.samples
        return np.asarray((samples.rate - light - place.own[..., 5:]) * np.sqrt(np.asarray(samples.weight)))

    def with_overlaps(self, theta: Float[np.ndarray, " p"]) -> DiffractionProblem:
        """Set the overlaps to those of ``theta``: they hardly change in a descent."""
        overlaps = np.asarray(overlaps_by_position(self.evaluator, theta, self.samples))
        return replace(self, samples=replace(self.samples, overlaps=overlaps))

    def about(self, place: Place) -> DiffractionProblem:
        """Set interference up about a place."""
        if not self.evaluator.interference:
            return self.with_overlaps(place.theta)
        return replace(self, samples=with_interference(self.evaluator, place.theta, self.samples, place.own[..., :2]))


def stepped(theta: Float[np.ndarray, " p"], step: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Return parameters after a step; spectra grow by the step itself, not by its exponential."""
    spectra = softmax(theta[HEAD:].reshape(3, -1), axis=1)
    logs = step[HEAD:].reshape(3, -1)
    mean = np.sum(spectra * logs, axis=1, keepdims=True)
    grown = logs - mean
    grown = np.where(grown > 0, np.log1p(np.maximum(grown, 0.0)), grown)
    return theta + np.concatenate([step[:HEAD], (mean + grown).ravel()])


def moved_own(own: Float[np.ndarray, "*k l"], step: Float[np.ndarray, "*k l"]) -> Float[np.ndarray, "*k l"]:
    """Return own parameters after a step; places of LEDs move by half a pixel at most."""
    return own + np.concatenate([np.clip(step[..., :2], -0.5, 0.5), step[..., 2:]], axis=-1)


@eqx.filter_jit
def overlaps_by_position(
    evaluator: Evaluator, theta: Theta, samples: Samples
) -> Float[Array, "positions nodes terms rows half"]:
    """Return overlaps at every position; see ``kernel.overlaps_of``."""
    return jax.lax.map(lambda frame: overlaps_of(evaluator, theta, frame), samples.frame)


@eqx.filter_jit
def coefficients_of(evaluator: Evaluator, theta: Theta, samples: Samples) -> Float[Array, "positions y x 3"]:
    """Return the kernel's spline coefficients at every position."""
    return jax.lax.map(lambda one: _coefficients(evaluator, jnp.asarray(theta), one), samples)


def _coefficients(evaluator: Evaluator, theta: Theta, one: Samples) -> Float[Array, "y x 3"]:
    overlaps = one.overlaps if np.shape(one.overlaps)[-1] else overlaps_of(evaluator, theta, one.frame)
    return kernel_coefficients(evaluator, theta, one.frame, one.disc_px, overlaps)


@eqx.filter_jit
def light_of(evaluator: Evaluator, theta: Theta, samples: Samples, own: Owns) -> Lights:
    """Return the samples' light under the model, in e-/s, without background."""
    theta = jnp.asarray(theta)

    def one(pair: tuple[Samples, Array]) -> Light:
        here, mine = pair
        unit = unit_light(evaluator, here, mine[:, :2], _coefficients(evaluator, theta, here))
        return _corrected(here, theta, unit) * flux_of(here, mine)

    return jax.lax.map(one, (samples, jnp.asarray(own)))


def _corrected(one: Samples, theta: Theta, unit: Light) -> Light:
    """Add to the light per unit the changes by a shot's own place and by overlaps, to first order."""
    return unit + one.correction + one.by_overlaps @ (theta[_IN_OVERLAPS] - one.overlaps_at)


@eqx.filter_jit
def with_interference(
    evaluator: Evaluator, theta: Theta, samples: Samples, offset_px: Float[Arrayish, "positions shots 2"]
) -> Samples:
    """Return samples with overlaps of ``theta``, their derivatives, and corrections for each shot's own place."""
    theta = jnp.asarray(theta)

    def one(pair: tuple[Samples, Array]) -> tuple[Array, Array, Array]:
        here, offset = pair
        frame, model = here.frame, evaluator.model(theta)
        overlaps, place = overlaps_of(evaluator, theta, frame), footprint_place(model, frame)
        coefficients = interference_coefficients(evaluator, model, frame, here.disc_px)

        def light(strength: Float[Array, " terms"], own: Float[Array, "nodes terms rows half"]) -> Float[Array, "s n"]:
            return unit_light(evaluator, here, offset, coefficients(strength, own))

        # Overlaps are in single precision: steps of this length (mm) keep their difference precise. Steps ten times as
        # long change derivatives by some per cent.
        strength, steps_mm = strengths(model, place), jnp.array([0.0002, 0.001])
        larger = theta + steps_mm[:, None] * jnp.eye(theta.size)[_IN_OVERLAPS]
        by_overlaps = (
            jax.lax.map(lambda at: light(strength, overlaps_of(evaluator, at, frame) - overlaps), larger)
            / steps_mm[:, None, None]
        )
        slope = frame.direction[:2] / frame.direction[2]
        tangent = (jnp.eye(2) + jnp.outer(slope, slope)) / frame.direction[2]
        along = model.standoff_per_pitch * (here.begun_px + offset) @ (tangent @ frame.jacobian).T

        def elsewhere(move: Float[Array, "2"]) -> Light:
            return light(strengths(model, place + move) - strength, overlaps)

        of_shots = jnp.diagonal(jax.lax.map(elsewhere, along), axis1=0, axis2=1).T
        return overlaps, of_shots, jnp.moveaxis(by_overlaps, 0, -1)

    overlaps, correction, by_overlaps = jax.lax.map(one, (samples, jnp.asarray(offset_px)))
    at = jnp.tile(theta[_IN_OVERLAPS], (len(overlaps), 1))
    return replace(samples, overlaps=overlaps, correction=correction, by_overlaps=by_overlaps, overlaps_at=at)


@eqx.filter_jit
def normal_equations(evaluator: Evaluator, theta: Theta, samples: Samples, own: Owns) -> tuple[Array, ...]:
    """Return each position's part of the Gauss-Newton equations, with Huber's weights.

    The order is that of ``engine.least_squares.Blocks``, without the number of samples.
    """
    theta = jnp.asarray(theta)
    return jax.lax.map(lambda pair: _normal_equations(evaluator, theta, *pair), (samples, jnp.asarray(own)))


def _normal_equations(evaluator: Evaluator, theta: Theta, one: Samples, own: Own) -> tuple[Array, ...]:
    model, colour = evaluator.model(theta), one.colour
    spectra = jnp.asarray(model.spectrum)
    coefficients, by_factor = kernel_jacobian(evaluator, model, one.frame, one.disc_px, one.overlaps)
    count = spectra.shape[1]
    parts = jnp.concatenate([coefficients, by_factor.reshape(*coefficients.shape[:2], -1)], axis=-1)
    values = sampled(evaluator, one, parts, own[:, :2])
    nodes, by_colour = values[..., :count], values[..., count:].reshape(*values.shape[:2], -1, 3)
    unit = jnp.einsum("snj,cj,snc->sn", nodes, spectra, colour)
    by_head = jnp.einsum("snfc,snc->snf", by_colour, colour) @ factor_jacobian(evaluator, theta, one.frame)
    by_head = by_head.at[..., _IN_OVERLAPS].add(one.by_overlaps)
    by_logs = jnp.einsum("snc,cj,snj->sncj", colour, spectra, nodes - unit[..., None])
    by_theta = jnp.concatenate([by_head, by_logs.reshape(*unit.shape, -1)], axis=-1) * flux_of(one, own)[..., None]
    unit = _corrected(one, theta, unit)
    by_own, residual, huber = own_jacobian(evaluator, one, own, unit, coefficients @ spectra.T)
    size = jnp.abs(residual) * jnp.sqrt(one.weight)
    return (
        jnp.sum(jnp.where(size < HUBER.sigma, size**2, 2.0 * HUBER.sigma * size - HUBER.sigma**2)),
        jnp.einsum("snp,sn,snq->pq", by_theta, huber, by_theta),
        jnp.einsum("snp,sn->p", by_theta, huber * residual),
        jnp.einsum("snk,sn,snl->skl", by_own, huber, by_own),
        jnp.einsum("snl,sn->sl", by_own, huber * residual),
        jnp.einsum("snp,sn,snl->spl", by_theta, huber, by_own),
    )


def explain(
    problem: DiffractionProblem, theta: Float[np.ndarray, " p"], shots: Shots, geometry: Geometry, model_error: float
) -> tuple[Float[np.ndarray, "shots l"], Crops]:
    """Apply a fit's diffraction to whole crops: return own parameters, (x, y) on the sensor, and light per unit."""
    evaluator = replace(problem.evaluator, lattice=fit_lattice(shots.half))
    samples = weighed(gather(shots, geometry, np.ones(shots.rate.shape, dtype=bool)), model_error)
    coefficients = coefficients_of(evaluator, theta, samples)
    own = start_own(evaluator, samples, coefficients)
    for _ in range(3):
        matrix, right, _ = (np.asarray(part) for part in own_equations(evaluator, samples, own, coefficients))
        own = moved_own(own, np.einsum("pslm,psm->psl", scaled_inverse(matrix, 1e-14), right))
    unit = np.asarray(own_equations(evaluator, samples, own, coefficients)[2])
    index = np.asarray(samples.index)
    found, explained = np.zeros((shots.count, OWN)), np.zeros(shots.rate.shape)
    found[index[index >= 0]] = own[index >= 0]
    explained[index[index >= 0]] = unit[index >= 0].reshape(-1, *shots.rate.shape[1:])
    found[:, :2] += shots.centre_px
    return found, explained
