"""Diffraction as a problem for the engine's solver: shared parameters of panel and light, own ones of every shot.

Interference changes with where the pupil's footprint lies and with its overlaps, which are slow to follow: it is set up
about one place, with what it needs to be right around it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
from jaxtyping import Float
from scipy.special import softmax

from udccal.fitting.engine.gaussian import Prior, scaled_inverse
from udccal.fitting.engine.least_squares import Blocks, Step
from udccal.fitting.psf.data import Shots
from udccal.fitting.psf.kernel import FOOTPRINT, HEAD, Evaluator, fit_lattice, kernel_coefficients, overlaps_of
from udccal.fitting.psf.samples import (
    IN_OVERLAPS,
    OWN,
    Block,
    blocks,
    corrected,
    normal_equations,
    own_equations,
    start_own,
    unit_light,
)
from udccal.fitting.psf.weights import weighed
from udccal.models.geometry import Geometry

_MAX_STEP_PX: Final = 0.5
_OWN_ROUNDS: Final = 3
# Overlaps are in single precision: by such steps of the pitch and the pupil, their difference is not. Over steps ten
# times as long derivatives bend by some percent.
_OVERLAP_STEPS_MM: Final = np.array([0.0002, 0.001])


@final
@dataclass(frozen=True)
class Place:
    """Where a descent is: the shared parameters of diffraction, and those of every shot; see ``psf.samples``."""

    theta: Float[np.ndarray, " p"]
    own: Float[np.ndarray, "positions shots l"]


@final
@dataclass(frozen=True)
class DiffractionProblem:
    """Diffraction for the engine's solver; the groups of its equations are the shots, position after position."""

    blocks: tuple[Block, ...]
    evaluator: Evaluator
    prior: Prior
    name: str = "psf"

    @property
    def samples(self) -> int:
        """How many samples count."""
        return int(sum((np.asarray(b.weight) > 0).sum() for b in self.blocks))

    @property
    def unknowns(self) -> int:
        """How many numbers they are to tell, those of each shot included."""
        return self.prior.mean.size + OWN * sum(int((np.asarray(b.index) >= 0).sum()) for b in self.blocks)

    def by_position(self, place: Place) -> list[Blocks]:
        """Each position's share of the equations, without the prior."""
        made = []
        for block, own in zip(self.blocks, place.own, strict=True):
            cost, *parts = (np.asarray(part) for part in normal_equations(self.evaluator, place.theta, block, own))
            made.append(Blocks(float(cost), int((np.asarray(block.weight) > 0).sum()), *parts))
        return made

    def equations_at(self, place: Place) -> Blocks:
        """Cost and normal equations, the prior's included."""
        made = self.by_position(place)
        own = (np.concatenate([getattr(one, part) for one in made]) for part in ("own", "own_right", "cross"))
        shared, right = sum(one.shared for one in made), sum(one.right for one in made)
        whole = Blocks(sum(one.cost for one in made), self.samples, np.asarray(shared), np.asarray(right), *own)
        return whole.with_prior(self.prior, place.theta)

    def moved(self, place: Place, step: Step) -> Place:
        """The place after a step."""
        return Place(stepped(place.theta, step.shared), _moved(place.own, step.own.reshape(place.own.shape)))

    def coefficients(self, theta: Float[np.ndarray, " p"], block: Block) -> np.ndarray:
        """Of the kernel at a block's place."""
        return np.asarray(kernel_coefficients(self.evaluator, theta, block.frame, block.disc_px, block.overlaps))

    def light_at(self, place: Place) -> list[Float[np.ndarray, "shots n"]]:
        """What each position's samples hold under the model, in e-/s, without background."""
        lights = []
        for block, own in zip(self.blocks, place.own, strict=True):
            unit = unit_light(self.evaluator, block, own[:, :2], self.coefficients(place.theta, block))
            flux = np.einsum("snc,sc->sn", block.colour, own[:, 2:5])
            lights.append(np.asarray(corrected(block, place.theta, unit)) * flux)
        return lights

    def errors(self, place: Place, lights: list[Float[np.ndarray, "shots n"]]) -> list[Float[np.ndarray, "shots n"]]:
        """Data less expectation in units of sigma, 0 where there is no sample that counts; ``lights`` of that place."""
        return [
            (np.asarray(block.rate) - light - own[:, 5:]) * np.sqrt(np.asarray(block.weight))
            for block, own, light in zip(self.blocks, place.own, lights, strict=True)
        ]

    def with_overlaps(self, theta: Float[np.ndarray, " p"]) -> DiffractionProblem:
        """With interference about ``theta``: what it depends on hardly changes in a descent."""
        made = (replace(b, overlaps=np.asarray(overlaps_of(self.evaluator, theta, b.frame))) for b in self.blocks)
        return replace(self, blocks=tuple(made))

    def with_corrections(self, place: Place) -> DiffractionProblem:
        """Blocks that know each shot's own place on the rows, and how overlaps change with the pitch and the pupil."""
        there = self.with_overlaps(place.theta)
        if not self.evaluator.interference:
            return there
        pairs = zip(there.blocks, place.own, strict=True)
        return replace(there, blocks=tuple(_with_corrections(there, place.theta, *pair) for pair in pairs))


def _with_corrections(
    problem: DiffractionProblem, theta: Float[np.ndarray, " p"], block: Block, own: Float[np.ndarray, "shots l"]
) -> Block:
    evaluator, offset = problem.evaluator, own[:, :2]

    def unit(at: Float[np.ndarray, " p"], overlaps: np.ndarray) -> Float[np.ndarray, "shots n"]:
        coefficients = problem.coefficients(at, replace(block, overlaps=overlaps))
        return np.asarray(unit_light(evaluator, block, offset, coefficients))

    here = np.asarray(block.overlaps)
    # The kernel is linear in its overlaps: what their change alone brings, beside what no overlap brings.
    without = unit(theta, np.zeros_like(here))
    by_overlaps = []
    for number, step_mm in zip(IN_OVERLAPS, _OVERLAP_STEPS_MM, strict=True):
        larger = theta + step_mm * np.eye(theta.size)[number]
        changed = np.asarray(overlaps_of(evaluator, larger, block.frame)) - here
        by_overlaps.append((unit(theta, changed) - without) / step_mm)
    direction = np.asarray(block.frame.direction)
    tangent = (np.eye(2) + np.outer(direction[:2], direction[:2]) / direction[2] ** 2) / direction[2]
    along = (np.asarray(block.begun_px) + offset) @ (tangent @ np.asarray(block.frame.jacobian)).T
    elsewhere = []
    for shot, move in enumerate(theta[FOOTPRINT][2] * along):
        moved = theta.copy()
        moved[FOOTPRINT] += [*move, 0.0]
        elsewhere.append(unit(moved, here)[shot])
    correction = np.stack(elsewhere) - unit(theta, here)
    stacked = np.stack(by_overlaps, axis=-1)
    return replace(block, correction=correction, by_overlaps=stacked, overlaps_at=theta[IN_OVERLAPS])


def stepped(theta: Float[np.ndarray, " p"], step: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Parameters after a step; light grows by what the step says, not by that number's exponential."""
    spectra = softmax(theta[HEAD:].reshape(3, -1), axis=1)
    logs = step[HEAD:].reshape(3, -1)
    mean = np.sum(spectra * logs, axis=1, keepdims=True)
    grown = logs - mean
    grown = np.where(grown > 0, np.log1p(np.maximum(grown, 0.0)), grown)
    return theta + np.concatenate([step[:HEAD], (mean + grown).ravel()])


def explain(
    problem: DiffractionProblem, theta: Float[np.ndarray, " p"], shots: Shots, geometry: Geometry, model_error: float
) -> tuple[Float[np.ndarray, "shots l"], Float[np.ndarray, "shots rows columns"]]:
    """What diffraction brings to whole crops.

    Args:
        problem: fitted. theta: its solution.
        shots: all there are.
        geometry: where pixels look.
        model_error: allowed for beside noise.

    Returns:
        (own parameters of all shots, with (x, y) on the sensor; light per unit of every sample).
    """
    evaluator = replace(problem.evaluator, lattice=fit_lattice(shots.half))
    found, explained = np.zeros((shots.count, OWN)), np.zeros(shots.rate.shape)
    for block in blocks(shots, geometry, np.ones(shots.rate.shape, dtype=bool)):
        alone = replace(problem, blocks=(weighed(block, model_error),), evaluator=evaluator).with_overlaps(theta)
        (block,), coefficients = alone.blocks, alone.coefficients(theta, alone.blocks[0])
        own = start_own(evaluator, block, coefficients)
        for _ in range(_OWN_ROUNDS):
            matrix, right = (np.asarray(part) for part in own_equations(evaluator, block, own, coefficients))
            own = _moved(own, np.einsum("slm,sm->sl", scaled_inverse(matrix, 1e-14), right))
        unit = np.asarray(unit_light(evaluator, block, own[:, :2], coefficients))
        index = np.asarray(block.index)
        real = index >= 0
        found[index[real]], explained[index[real]] = own[real], unit[real].reshape(-1, *shots.rate.shape[1:])
    found[:, :2] += shots.centre_px
    return found, explained


def _moved(own: Float[np.ndarray, "*k l"], step: Float[np.ndarray, "*k l"]) -> Float[np.ndarray, "*k l"]:
    """Places of LEDs move by no more than half a pixel in a step."""
    bounded = step.copy()
    bounded[..., :2] = np.clip(bounded[..., :2], -_MAX_STEP_PX, _MAX_STEP_PX)
    return own + bounded
