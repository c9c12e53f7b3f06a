"""Levenberg-Marquardt over the few numbers of diffraction, with every shot's own unknowns (place, light per colour,
background) taken out of the normal equations by Schur's complement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import softmax

from udccal.fitting.engine.iteration_log import LOG
from udccal.fitting.psf.blocks import HEAD, LOCAL, Block, Local
from udccal.fitting.psf.normal import Evaluator, Normal, normal_equations, overlaps_of

_MAX_STEP_PX = 0.5
_FIRST_DAMPING, _LAST_DAMPING = 1e-2, 1e6
# In units of chi-squared: what is promised, and what the last step brought.
_SMALL, _STALLED = 1.0, 0.05


@dataclass(frozen=True)
class Prior:
    """Gaussian prior of the global parameters: mean, a root of the inverse covariance, and the nodes of the spectra."""

    mean: Float[np.ndarray, " p"]
    root: Float[np.ndarray, "rows p"]
    wavelengths_nm: Float[np.ndarray, " nodes"]


@dataclass(frozen=True)
class Problem:
    """What stays the same from iteration to iteration; ``overlaps`` go with ``blocks``."""

    blocks: tuple[Block, ...]
    overlaps: tuple[np.ndarray, ...]
    evaluator: Evaluator
    prior: Prior

    @property
    def samples(self) -> int:
        """How many samples count."""
        return int(sum((np.asarray(b.weight) > 0).sum() for b in self.blocks))

    @property
    def unknowns(self) -> int:
        """How many numbers they are to tell, those of each shot included."""
        return self.prior.mean.size + LOCAL * sum(int((np.asarray(b.index) >= 0).sum()) for b in self.blocks)


@dataclass(frozen=True)
class Point:
    """Where a descent stands: global parameters, each shot's own, and the normal equations there."""

    theta: Float[np.ndarray, " p"]
    local: tuple[Local, ...]
    cost: float
    normals: tuple[Normal, ...]
    iterations: int
    converged: bool


def pose(blocks: tuple[Block, ...], evaluator: Evaluator, prior: Prior, near: Float[np.ndarray, " p"]) -> Problem:
    """The problem of fitting ``blocks``, whose solution is about ``near``."""
    overlaps = tuple(np.asarray(overlaps_of(evaluator, near, block.frame)) for block in blocks)
    return Problem(blocks, overlaps, evaluator, prior)


def stand(problem: Problem, theta: Float[np.ndarray, " p"], local: tuple[Local, ...], iterations: int = 0) -> Point:
    """The normal equations at a place."""
    normals = tuple(
        normal_equations(problem.evaluator, theta, block, one, overlaps)
        for block, one, overlaps in zip(problem.blocks, local, problem.overlaps, strict=True)
    )
    strain = problem.prior.root @ (theta - problem.prior.mean)
    return Point(theta, local, float(sum(float(n.cost) for n in normals) + strain @ strain), normals, iterations, False)


def descend(problem: Problem, point: Point, most: int, enough: float) -> Point:
    """Steps from ``point``, until the next would lower the cost by less than ``enough``; at most ``most`` in all.

    Slopes that are themselves sums over a lattice promise a little for ever: where little is promised and the last step
    brought next to nothing, that is the end, too.
    """
    damping, raise_by, iterations, lowered = _FIRST_DAMPING, 2.0, point.iterations, np.inf
    while True:
        step, moves, gain = _step(problem, point, damping)
        converged = bool(np.isfinite(gain)) and (gain < enough or (gain < _SMALL and lowered < _STALLED))
        if converged or iterations >= most or damping > _LAST_DAMPING:
            return Point(point.theta, point.local, point.cost, point.normals, iterations, converged)
        iterations += 1
        tried = tuple(moved(one, move) for one, move in zip(point.local, moves, strict=True))
        new = stand(problem, stepped(point.theta, step), tried, iterations)
        LOG.debug("psf: iteration %d, chi2 %.9g, damping %.1g", iterations, new.cost, damping)
        if np.isfinite(new.cost) and new.cost < point.cost:
            lowered, point = point.cost - new.cost, new
            damping, raise_by = damping * _lower_by(lowered / gain), 2.0
        else:
            damping, raise_by = damping * raise_by, 2.0 * raise_by


def stepped(theta: Float[np.ndarray, " p"], step: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Global parameters after a step; light grows by what the step says, not by that number's exponential."""
    spectra = softmax(theta[HEAD:].reshape(3, -1), axis=1)
    logs = step[HEAD:].reshape(3, -1)
    mean = np.sum(spectra * logs, axis=1, keepdims=True)
    grown = logs - mean
    grown = np.where(grown > 0, np.log1p(np.maximum(grown, 0.0)), grown)
    return theta + np.concatenate([step[:HEAD], (mean + grown).ravel()])


def _lower_by(kept: float) -> float:
    """Factor on the damping after a step that kept this share of its promise (Nielsen, IMM-REP-1999-05, eq. 2.5)."""
    return float(np.clip(1.0 - (2.0 * kept - 1.0) ** 3, 0.1, 2.0))


def reduced(
    problem: Problem, point: Point, damping: float = 0.0
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"], list[Float[np.ndarray, "shots l l"]]]:
    """Normal equations of the global parameters, prior included, and the inverses of the shots' own."""
    root = problem.prior.root
    matrix, right = root.T @ root, -root.T @ (root @ (point.theta - problem.prior.mean))
    inverses = []
    for normal in point.normals:
        own, slope, inverse = without_locals(normal, damping)
        matrix, right = matrix + own, right + slope
        inverses.append(inverse)
    return matrix, right, inverses


def without_locals(
    normal: Normal, damping: float = 0.0
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"], Float[np.ndarray, "shots l l"]]:
    """One position's share of the equations after its shots' own unknowns are eliminated."""
    inverse = np.linalg.inv(damped(np.asarray(normal.ll), damping))
    cross = np.asarray(normal.gl)
    matrix = np.asarray(normal.gg) - np.einsum("spl,slm,sqm->pq", cross, inverse, cross)
    return matrix, np.asarray(normal.g) - np.einsum("spl,slm,sm->p", cross, inverse, np.asarray(normal.l)), inverse


def damped(matrix: Float[np.ndarray, "shots l l"], damping: float) -> Float[np.ndarray, "shots l l"]:
    """Diagonals raised by a fraction; a shot that only fills up a block has none, and gets 1."""
    diagonal = np.einsum("sll->sl", matrix)
    return matrix + np.einsum("sl,lm->slm", damping * diagonal + (diagonal == 0), np.eye(LOCAL))


def moved(local: Local, move: Float[np.ndarray, "shots l"]) -> Local:
    """Each shot's own unknowns after a step, places by no more than half a pixel."""
    bounded = np.clip(move[:, :2], -_MAX_STEP_PX, _MAX_STEP_PX)
    return Local(local.offset_px + bounded, local.flux + move[:, 2:5], local.background + move[:, 5])


def _step(
    problem: Problem, point: Point, damping: float
) -> tuple[Float[np.ndarray, " p"], list[Float[np.ndarray, "shots l"]], float]:
    """A step of the global parameters, of the shots' own, and by how much it would lower the cost."""
    matrix, right, inverses = reduced(problem, point, damping)
    step = np.linalg.solve(matrix + damping * np.diag(np.diagonal(matrix)), right)
    gain, moves = float(right @ step), []
    for normal, inverse in zip(point.normals, inverses, strict=True):
        alone = np.einsum("slm,sm->sl", inverse, np.asarray(normal.l))
        gain += float(np.sum(alone * np.asarray(normal.l)))
        moves.append(alone - np.einsum("slm,spm,p->sl", inverse, np.asarray(normal.gl), step))
    return step, moves, gain
