"""Fit of the diffraction field to LED pictures: Levenberg-Marquardt over the few global parameters, with every shot's
own unknowns (place, light per colour, background) taken out of the normal equations by Schur's complement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf_blocks import LOCAL, Block, Local
from udccal.fitting.psf_normal import (
    Evaluator,
    Normal,
    kernel_coefficients,
    local_equations,
    normal_equations,
    overlaps_of,
    unit_light,
)
from udccal.fitting.psf_places import start_local
from udccal.models.diffraction import Diffraction

_MAX_STEP_PX = 0.5
_FIRST_DAMPING, _LAST_DAMPING = 1e-2, 1e6


@dataclass(frozen=True)
class Prior:
    """Gaussian prior of the global parameters: mean, and a root of the inverse covariance."""

    mean: Float[np.ndarray, " p"]
    root: Float[np.ndarray, "rows p"]


@dataclass(frozen=True)
class DiffractionFit:
    """``theta`` are the global parameters that ``unpack`` understands, ``cov`` their covariance."""

    theta: Float[np.ndarray, " p"]
    cov: Float[np.ndarray, "p p"]
    chi2_dof: float
    samples: int
    iterations: int
    converged: bool


@dataclass(frozen=True)
class Problem:
    """Everything that stays the same from iteration to iteration; ``overlaps`` go with ``blocks``."""

    blocks: tuple[Block, ...]
    overlaps: tuple[np.ndarray, ...]
    evaluator: Evaluator
    prior: Prior


def pose(blocks: tuple[Block, ...], evaluator: Evaluator, prior: Prior) -> Problem:
    """The problem of fitting ``blocks``, starting from the prior's mean."""
    overlaps = tuple(np.asarray(overlaps_of(evaluator, prior.mean, block.frame)) for block in blocks)
    return Problem(blocks, overlaps, evaluator, prior)


def fit_diffraction(problem: Problem, max_iterations: int, tolerance: float = 2e-3) -> DiffractionFit:
    """Levenberg-Marquardt from the prior's mean until the cost falls by less than ``tolerance`` of itself."""
    theta = problem.prior.mean.copy()
    local = tuple(
        start_local(
            problem.evaluator, block, np.asarray(kernel_coefficients(problem.evaluator, theta, block, overlaps))
        )
        for block, overlaps in zip(problem.blocks, problem.overlaps, strict=True)
    )
    damping, converged, iterations = _FIRST_DAMPING, False, 0
    cost, normals = _evaluate(problem, theta, local)
    while iterations < max_iterations and not converged:
        iterations += 1
        step, moves = _step(problem, theta, normals, damping)
        tried = tuple(_moved(one, move) for one, move in zip(local, moves, strict=True))
        new_cost, new_normals = _evaluate(problem, theta + step, tried)
        # Weights follow the model: the cost at the solution need not be the least, so a small change either way ends.
        converged = abs(cost - new_cost) < tolerance * cost or damping > _LAST_DAMPING
        if np.isfinite(new_cost) and new_cost < cost:
            theta, local, cost, normals = theta + step, tried, new_cost, new_normals
            damping /= 5.0
        else:
            damping *= 8.0
    return _result(problem, theta, cost, normals, iterations, converged)


def fit_locals(
    evaluator: Evaluator, theta: Float[np.ndarray, " p"], block: Block, rounds: int = 3
) -> tuple[Local, Float[np.ndarray, "shots n"]]:
    """Own unknowns of one position's shots for a given model, and what one unit of light brings to their samples."""
    overlaps = overlaps_of(evaluator, theta, block.frame)
    coefficients = np.asarray(kernel_coefficients(evaluator, theta, block, overlaps))
    local = start_local(evaluator, block, coefficients)
    for _ in range(rounds):
        matrix, right = (np.asarray(part) for part in local_equations(evaluator, block, local, coefficients))
        local = _moved(local, np.linalg.solve(_damped(matrix, 1e-9), right[..., None])[..., 0])
    return local, np.asarray(unit_light(evaluator, block, local.offset_px, coefficients))


def _evaluate(problem: Problem, theta: Float[np.ndarray, " p"], local: tuple[Local, ...]) -> tuple[float, list[Normal]]:
    normals = [
        normal_equations(problem.evaluator, theta, block, one, overlaps)
        for block, one, overlaps in zip(problem.blocks, local, problem.overlaps, strict=True)
    ]
    strain = problem.prior.root @ (theta - problem.prior.mean)
    return float(sum(float(n.cost) for n in normals) + strain @ strain), normals


def _damped(matrix: Float[np.ndarray, "shots l l"], damping: float) -> Float[np.ndarray, "shots l l"]:
    """Diagonals raised by a fraction; a shot that only fills up a block has none, and gets 1."""
    diagonal = np.einsum("sll->sl", matrix)
    return matrix + np.einsum("sl,lm->slm", damping * diagonal + (diagonal == 0), np.eye(LOCAL))


def _reduced(
    problem: Problem, theta: Float[np.ndarray, " p"], normals: list[Normal], damping: float
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"], list[Float[np.ndarray, "shots l l"]]]:
    """Global normal equations after each shot's own unknowns are eliminated."""
    root = problem.prior.root
    matrix, right = root.T @ root, -root.T @ (root @ (theta - problem.prior.mean))
    inverses = []
    for normal in normals:
        inverse = np.linalg.inv(_damped(np.asarray(normal.ll), damping))
        cross = np.asarray(normal.gl)
        matrix = matrix + np.asarray(normal.gg) - np.einsum("spl,slm,sqm->pq", cross, inverse, cross)
        right = right + np.asarray(normal.g) - np.einsum("spl,slm,sm->p", cross, inverse, np.asarray(normal.l))
        inverses.append(inverse)
    return matrix, right, inverses


def _step(
    problem: Problem, theta: Float[np.ndarray, " p"], normals: list[Normal], damping: float
) -> tuple[Float[np.ndarray, " p"], list[Float[np.ndarray, "shots l"]]]:
    matrix, right, inverses = _reduced(problem, theta, normals, damping)
    step = np.linalg.solve(matrix + damping * np.diag(np.diagonal(matrix)), right)
    moves = [
        np.einsum("slm,sm->sl", inverse, np.asarray(n.l) - np.einsum("spl,p->sl", np.asarray(n.gl), step))
        for n, inverse in zip(normals, inverses, strict=True)
    ]
    return step, moves


def _moved(local: Local, move: Float[np.ndarray, "shots l"]) -> Local:
    bounded = np.clip(move[:, :2], -_MAX_STEP_PX, _MAX_STEP_PX)
    return Local(local.offset_px + bounded, local.flux + move[:, 2:5], local.background + move[:, 5])


def _result(
    problem: Problem,
    theta: Float[np.ndarray, " p"],
    cost: float,
    normals: list[Normal],
    iterations: int,
    converged: bool,
) -> DiffractionFit:
    matrix, _, _ = _reduced(problem, theta, normals, 0.0)
    samples = int(sum((np.asarray(b.weight) > 0).sum() for b in problem.blocks))
    shots = sum(int((np.asarray(b.index) >= 0).sum()) for b in problem.blocks)
    return DiffractionFit(
        theta=theta,
        cov=np.linalg.pinv(matrix, hermitian=True),
        chi2_dof=cost / max(samples - LOCAL * shots - theta.size, 1),
        samples=samples,
        iterations=iterations,
        converged=converged,
    )


def fitted_model(evaluator: Evaluator, theta: Float[np.ndarray, " p"]) -> Diffraction:
    """The fitted model with numpy leaves."""
    model = evaluator.model(theta)
    leaves = (np.asarray(getattr(model, name), dtype=np.float64) for name in Diffraction.__dataclass_fields__)
    return Diffraction(*leaves)
