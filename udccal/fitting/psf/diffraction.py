"""Fit of the diffraction field to LED pictures: maximum likelihood with the sensor's noise and a model error that the
residuals tell.

Rounds of a descent with fixed weights; between them the weights follow the model, and outliers go.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.iteration_log import LOG
from udccal.fitting.psf.blocks import FOOTPRINT, PITCH, PUPIL, Block, Local, corrected
from udccal.fitting.psf.descent import Point, Problem, damped, descend, moved, pose, reduced, stand
from udccal.fitting.psf.normal import (
    Evaluator,
    kernel_coefficients,
    local_equations,
    overlaps_of,
    unit_light,
)
from udccal.fitting.psf.outliers import without_outliers
from udccal.fitting.psf.pattern import pattern_p_value
from udccal.fitting.psf.places import start_local
from udccal.fitting.psf.weights import estimate_model_error, first_weights, left_out, model_weights, sensor_variance
from udccal.models.diffraction import Diffraction
from udccal.result import Outliers

# Until the residuals tell; it also keeps a fit that is still far off from trusting the brightest samples alone.
FIRST_MODEL_ERROR = 0.015
_ROUNDS = 5
# The first descent ends where it would gain this share of the cost; rounds where they would gain so much, those after
# which the weights hardly change anything and the others.
_ROUGHLY, _FULLY, _NEARLY = 1e-3, 1e-2, 1.0
# In sigma: a round that moves every parameter by less is the last; the weights are about those of the end.
_STILL, _SETTLED = 0.1, 1.0
# Overlaps change with these numbers. They are in single precision: by such steps, their difference is not. Over steps
# ten times as long slopes bend by some percent.
_OVERLAP_STEPS_MM = ((PITCH, 0.0002), (PUPIL, 0.001))


@dataclass(frozen=True)
class DiffractionFit:
    """What was found.

    Attributes:
        theta: the global parameters that ``unpack`` understands. cov: their covariance, the model error taken as
            independent from sample to sample.
        problem, point: the equations at the solution.
        model_error: as a fraction of the peak, see ``psf.weights``; 0 where the residuals are noise.
        chi2_dof: with that model error.
        pattern_p: how likely such a pattern in the residuals is by chance; see ``psf.pattern``.
    """

    theta: Float[np.ndarray, " p"]
    cov: Float[np.ndarray, "p p"]
    problem: Problem
    point: Point
    model_error: float
    chi2_dof: float
    pattern_p: float
    outliers: tuple[Outliers, ...]

    @property
    def converged(self) -> bool:
        """Whether a minimum was reached."""
        return self.point.converged and bool(np.isfinite(self.theta).all() and np.isfinite(self.cov).all())


def approach(problem: Problem, max_iterations: int) -> Point:
    """From the prior's mean to about the minimum, with weights that the data give."""
    problem = replace(problem, blocks=tuple(first_weights(block, FIRST_MODEL_ERROR) for block in problem.blocks))
    theta = problem.prior.mean.copy()
    local = tuple(
        start_local(
            problem.evaluator, block, np.asarray(kernel_coefficients(problem.evaluator, theta, block, overlaps))
        )
        for block, overlaps in zip(problem.blocks, problem.overlaps, strict=True)
    )
    point = stand(problem, theta, local)
    return descend(problem, point, max_iterations, _ROUGHLY * point.cost)


def refine(problem: Problem, point: Point, max_iterations: int) -> DiffractionFit:
    """From about the minimum to the maximum of the likelihood.

    Args:
        problem: what to fit; each shot's own unknowns in ``point`` are about its blocks' places.
        point: where to start; its normal equations are not looked at.
        max_iterations: of all descents together.
    """
    whole: DiffractionFit | None = None
    enough = _NEARLY
    for _ in range(_ROUNDS):
        # What interference depends on hardly changes in a descent, but it does.
        there = pose(problem.blocks, problem.evaluator, problem.prior, point.theta)
        corrected = replace(there, blocks=with_interference(there, point))
        problem, model_error, found = _reweighed(corrected, point)
        before = point.theta
        point = descend(problem, stand(problem, before, point.local, point.iterations), max_iterations, enough)
        matrix, _, _ = reduced(problem, point)
        change = point.theta - before
        LOG.debug("psf: model error %.3g, moved by %.3g sigma", model_error, float(np.sqrt(change @ matrix @ change)))
        if not point.converged:
            # Out of iterations: the round before, whose weights are those of a model not quite this one, has an end.
            return whole or _result(problem, point, model_error, found)
        whole = _result(problem, point, model_error, found)
        moved_by = change @ matrix @ change
        if enough == _FULLY and moved_by < _STILL**2:
            break
        enough = _FULLY if moved_by < _SETTLED**2 else _NEARLY
    assert whole is not None  # there is a first round
    return whole


def fit_locals(
    evaluator: Evaluator, theta: Float[np.ndarray, " p"], block: Block, model_error: float, rounds: int = 3
) -> tuple[Local, Float[np.ndarray, "shots n"]]:
    """Own unknowns of one position's shots for a given model, and what one unit of light brings to their samples."""
    overlaps = overlaps_of(evaluator, theta, block.frame)
    coefficients = np.asarray(kernel_coefficients(evaluator, theta, block, overlaps))
    block = first_weights(block, max(model_error, FIRST_MODEL_ERROR))
    local = start_local(evaluator, block, coefficients)
    for _ in range(rounds):
        matrix, right = (np.asarray(part) for part in local_equations(evaluator, block, local, coefficients))
        local = moved(local, np.linalg.solve(damped(matrix, 1e-9), right[..., None])[..., 0])
    return local, np.asarray(unit_light(evaluator, block, local.offset_px, coefficients))


def expected_light(problem: Problem, point: Point) -> list[Float[np.ndarray, "shots n"]]:
    """What each position's samples hold under the model, in e-/s, without background."""
    lights = []
    for block, local, overlaps in zip(problem.blocks, point.local, problem.overlaps, strict=True):
        unit = _unit(problem.evaluator, point.theta, block, local, overlaps)
        flux = np.einsum("snc,sc->sn", np.asarray(block.colour), np.asarray(local.flux))
        lights.append(np.asarray(corrected(block, point.theta, unit)) * flux)
    return lights


def _unit(
    evaluator: Evaluator, theta: Float[np.ndarray, " p"], block: Block, local: Local, overlaps: np.ndarray
) -> Float[np.ndarray, "shots n"]:
    coefficients = np.asarray(kernel_coefficients(evaluator, theta, block, overlaps))
    return np.asarray(unit_light(evaluator, block, local.offset_px, coefficients))


def with_interference(problem: Problem, point: Point) -> tuple[Block, ...]:
    """Blocks that know each shot's own place on the rows, and how overlaps change with the pupil."""
    if not problem.evaluator.interference:
        return problem.blocks
    theta, evaluator, made = point.theta, problem.evaluator, []
    for block, local, overlaps in zip(problem.blocks, point.local, problem.overlaps, strict=True):
        by_pitch, by_pupil = (
            _by_overlaps(problem.evaluator, theta, block, local, overlaps, step) for step in _OVERLAP_STEPS_MM
        )
        made.append(
            replace(
                block,
                correction=_by_phase(evaluator, theta, block, local, overlaps),
                overlap_slope=by_pupil,
                pitch_slope=by_pitch,
                overlaps_pupil_mm=theta[PUPIL],
                overlaps_pitch_mm=theta[PITCH],
            )
        )
    return tuple(made)


def _by_overlaps(
    evaluator: Evaluator,
    theta: Float[np.ndarray, " p"],
    block: Block,
    local: Local,
    overlaps: np.ndarray,
    step: tuple[int, float],
) -> Float[np.ndarray, "shots n"]:
    """By how much one unit of light changes per mm of a global parameter because overlaps do."""
    number, step_mm = step
    larger = theta.copy()
    larger[number] += step_mm
    changed = np.asarray(overlaps_of(evaluator, larger, block.frame)) - overlaps
    # The kernel is linear in its overlaps: what the change alone brings, beside what no overlap brings.
    brought, without = (_unit(evaluator, theta, block, local, own) for own in (changed, np.zeros_like(changed)))
    return (brought - without) / step_mm


def _by_phase(
    evaluator: Evaluator, theta: Float[np.ndarray, " p"], block: Block, local: Local, overlaps: np.ndarray
) -> Float[np.ndarray, "shots n"]:
    """What one unit of light brings more where each shot has the footprint at its own place, not at their mean one."""
    common = _unit(evaluator, theta, block, local, overlaps)
    direction = np.asarray(block.frame.direction)
    tangent = (np.eye(2) + np.outer(direction[:2], direction[:2]) / direction[2] ** 2) / direction[2]
    along = (np.asarray(block.begun_px) + np.asarray(local.offset_px)) @ (tangent @ np.asarray(block.frame.jacobian)).T
    units = []
    for shot, move in enumerate(theta[FOOTPRINT][2] * along):
        own = theta.copy()
        own[FOOTPRINT] += [*move, 0.0]
        units.append(_unit(evaluator, own, block, local, overlaps)[shot])
    return np.stack(units) - common


def _reweighed(problem: Problem, point: Point) -> tuple[Problem, float, tuple[Outliers, ...]]:
    """Weights at the model's light, with the model error that the residuals tell, and without outliers."""
    lights = expected_light(problem, point)
    residuals, variances, shares = [], [], []
    for block, local, light in zip(problem.blocks, point.local, lights, strict=True):
        seen = np.asarray(block.known) > 0
        expected = light + np.asarray(local.background)[:, None]
        residuals.append((np.asarray(block.rate) - expected)[seen])
        variances.append(sensor_variance(block, expected)[seen])
        shares.append(left_out(light * seen, 1.0)[seen])
    model_error = estimate_model_error(
        np.concatenate(residuals), np.concatenate(variances), np.concatenate(shares), problem.unknowns
    )
    weighed = [
        model_weights(block, light, local, model_error)
        for block, local, light in zip(problem.blocks, point.local, lights, strict=True)
    ]
    kept, found = without_outliers(weighed, lights, point.local)
    return replace(problem, blocks=kept), model_error, found


def _result(problem: Problem, point: Point, model_error: float, found: tuple[Outliers, ...]) -> DiffractionFit:
    matrix, _, _ = reduced(problem, point)
    residuals = [
        np.asarray(block.rate) - light - np.asarray(local.background)[:, None]
        for block, light, local in zip(problem.blocks, expected_light(problem, point), point.local, strict=True)
    ]
    strain = problem.prior.root @ (point.theta - problem.prior.mean)
    return DiffractionFit(
        theta=point.theta,
        cov=np.linalg.pinv(matrix, hermitian=True),
        problem=problem,
        point=point,
        model_error=model_error,
        chi2_dof=(point.cost - float(strain @ strain)) / max(problem.samples - problem.unknowns, 1),
        pattern_p=pattern_p_value(problem.blocks, residuals),
        outliers=found,
    )


def fitted_model(evaluator: Evaluator, theta: Float[np.ndarray, " p"]) -> Diffraction:
    """The fitted model with numpy leaves."""
    model = evaluator.model(theta)
    leaves = (np.asarray(getattr(model, name), dtype=np.float64) for name in Diffraction.__dataclass_fields__)
    return Diffraction(*leaves)
