"""Levenberg-Marquardt on normal equations by blocks: shared parameters, and nuisance parameters of one datum each.

The equations of one step are

    [ A    B ] [shared]     [a]        A: p x p,  B_k: p x l,  C_k: l x l, one block per view, shot or star,
    [ B^T  C ] [ own  ]  =  [c],

with C block diagonal. The nuisance parameters are therefore eliminated group by group (Schur's complement: Triggs et
al., Bundle Adjustment - A Modern Synthesis, 2000, section 6.1). The damping, which is the multiplier of a trust region
scaled by the diagonal (More, Lecture Notes in Mathematics 630, 1978), follows Nielsen (IMM-REP-1999-05, 1999).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar, final, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.gaussian import Prior, scaled_inverse

# Every solver writes its iterations here at level DEBUG: `udccal fit --log` shows them.
LOG = logging.getLogger("udccal.fitting")

Place = TypeVar("Place")
_Place_contra = TypeVar("_Place_contra", contravariant=True)

_TINY = 1e-300
# Steps that shrink more slowly than this tell little of the way that is left.
_SLOWEST = 0.9


@final
@dataclass(frozen=True)
class SolverRules:
    """When a descent ends, and how carefully it steps.

    Attributes:
        least_gain: converged when one more step is expected to gain less, in units of the reduced chi-squared where
            that is above 1. 1e-4 is a hundredth of a sigma.
        stalled_gain: also converged when the expected gain is below ``small_gain`` and the last step lowered the cost
            by less than this: inexact derivatives may predict a small gain for ever. 0 turns this rule off.
        small_gain: see ``stalled_gain``; also the expected gain that is accepted where rounding hides any progress.
        iterations: at most; far more than data take, so that it only bounds the time of a descent without an end.
        first_damping: relative to the diagonal of the equations.
        most_damping: the descent ends beyond it, since no step, however small, lowers the cost.
    """

    least_gain: float = 1e-4
    stalled_gain: float = 0.0
    small_gain: float = 1.0
    iterations: int = 200
    first_damping: float = 1e-4
    most_damping: float = 1e10


@final
@dataclass(frozen=True)
class Step:
    """A step of the shared and of the nuisance parameters, and ``gain``, the expected fall of the cost."""

    shared: Float[np.ndarray, " p"]
    own: Float[np.ndarray, "k l"]
    gain: float


@runtime_checkable
class Equations(Protocol):
    """The properties of a problem's equations that the solver uses; ``Blocks`` has them, and other classes may."""

    @property
    def cost(self) -> float:
        """Chi-squared with the prior's part."""

    @property
    def samples(self) -> int:
        """Data that count."""

    def step(self, damping: float) -> Step:
        """To the minimum of the quadratic model, whose diagonal is raised by the part ``damping``."""


_Equations = TypeVar("_Equations", bound=Equations)
_Equations_co = TypeVar("_Equations_co", bound=Equations, covariant=True)


@runtime_checkable
class Problem(Protocol[Place, _Equations_co]):
    """An adapter between a fit and the solver: it gives equations at a place, and the place after a step."""

    @property
    def name(self) -> str:
        """For the iteration log."""

    def equations_at(self, place: Place) -> _Equations_co:
        """Cost and normal equations at a place, with the prior's part."""

    def moved(self, place: Place, step: Step) -> Place:
        """The place after a step."""


@final
@dataclass(frozen=True)
class Blocks:
    """Normal equations by blocks; ``k`` groups of ``l`` nuisance parameters each, none where ``k`` is 0.

    Attributes:
        cost: chi-squared with the priors' part.
        samples: data that count.
        shared, right: half the Hessian and minus half the gradient of the cost by the shared parameters.
        own, own_right: the same by the nuisance parameters of each group.
        cross: half the Hessian, shared by own.
        held: shared parameters that make no step, such as those at a bound that the data push against; their
            covariance is that without the bound.
        stiffer: what a step adds to the diagonal of ``shared``: curvature that Gauss and Newton leave out. It is not in
            the covariance.
    """

    cost: float
    samples: int
    shared: Float[np.ndarray, "p p"]
    right: Float[np.ndarray, " p"]
    own: Float[np.ndarray, "k l l"]
    own_right: Float[np.ndarray, "k l"]
    cross: Float[np.ndarray, "k p l"]
    held: Bool[np.ndarray, " p"] | None = None
    stiffer: Float[np.ndarray, " p"] | None = None

    @classmethod
    def dense(
        cls, cost: float, samples: int, matrix: Float[np.ndarray, "p p"], right: Float[np.ndarray, " p"]
    ) -> Blocks:
        """Without groups."""
        size = len(right)
        return cls(cost, samples, matrix, right, np.zeros((0, 1, 1)), np.zeros((0, 1)), np.zeros((0, size, 1)))

    @classmethod
    def of_errors(cls, errors: Float[np.ndarray, " m"], slopes: Float[np.ndarray, "m p"]) -> Blocks:
        """Without groups, from errors in units of their sigma and their Jacobian."""
        return cls.dense(float(errors @ errors), len(errors), slopes.T @ slopes, -slopes.T @ errors)

    @classmethod
    def joined(cls, parts: Sequence[Blocks]) -> Blocks:
        """Of all data together: parts add up in the shared parameters, and each has groups of its own."""
        cost, samples = sum(one.cost for one in parts), sum(one.samples for one in parts)
        shared, right = np.sum([one.shared for one in parts], axis=0), np.sum([one.right for one in parts], axis=0)
        own = (np.concatenate([getattr(one, name) for one in parts]) for name in ("own", "own_right", "cross"))
        return cls(cost, samples, shared, right, *own)

    def with_prior(self, prior: Prior, x: Float[np.ndarray, " p"]) -> Blocks:
        """The same with a prior on the shared parameters, whose values are ``x``."""
        cost, matrix = self.cost + prior.cost(x), self.shared + prior.precision
        return replace(self, cost=cost, shared=matrix, right=self.right + prior.right(x))

    def marginal(self) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
        """Matrix and right side of the shared parameters once the nuisance parameters are eliminated."""
        return self._eliminated(0.0)[:2]

    def _eliminated(self, damping: float) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "k l l"]]:
        """The same with a raised diagonal, and the inverse of each group's block.

        A group that only fills up the array has zeros there, and does not move.
        """
        inverse = scaled_inverse(_damped(self.own, damping), 1e-14)
        solved = self.cross @ inverse
        matrix = _damped(self.shared, damping) - np.tensordot(solved, self.cross, ((0, 2), (0, 2)))
        return matrix, self.right - np.tensordot(solved, self.own_right, ((0, 2), (0, 1))), inverse

    def step(self, damping: float) -> Step:
        """To the minimum of the quadratic model, whose diagonal is raised by the part ``damping``."""
        matrix, right, inverse = self._eliminated(damping)
        if self.stiffer is not None:
            matrix = matrix + np.diag(self.stiffer)
        if self.held is not None:
            matrix = np.where(self.held[:, None] | self.held, np.diag(np.where(self.held, 1.0, 0.0)), matrix)
            right = np.where(self.held, 0.0, right)
        shared = solve(matrix, right)
        left = self.own_right - np.einsum("kpl,p->kl", self.cross, shared)
        own = np.einsum("klm,km->kl", inverse, left)
        return Step(shared, own, float(self.right @ shared + (self.own_right * own).sum()))

    def cov(self) -> Float[np.ndarray, "p p"]:
        """Covariance of the shared parameters, nuisance parameters marginalised; 0 where they are not determined."""
        return scaled_inverse(self.marginal()[0])

    def joint_cov(self, shared: Float[np.ndarray, "p p"] | None = None, widen: float = 1.0) -> Float[np.ndarray, "n n"]:
        """Covariance of the shared, then of the nuisance parameters group by group; ``n`` is p + k l.

        Args:
            shared: that of the shared parameters, if it is not ``cov()``; nuisance parameters follow them.
            widen: factor on the variance that a group's nuisance parameters have where the shared ones are known.
        """
        matrix, _, inverse = self._eliminated(0.0)
        shared = scaled_inverse(matrix) if shared is None else shared
        carried = -(inverse @ np.swapaxes(self.cross, 1, 2)).reshape(-1, len(self.right))
        cov = np.block([[shared, shared @ carried.T], [carried @ shared, carried @ shared @ carried.T]])
        size = inverse.shape[1]
        for group, block in enumerate(inverse):
            mine = slice(len(self.right) + group * size, len(self.right) + (group + 1) * size)
            cov[mine, mine] += widen * block
        return cov


def _damped(matrix: Float[np.ndarray, "*k n n"], damping: float) -> Float[np.ndarray, "*k n n"]:
    if damping == 0.0:
        return matrix
    diagonal = np.einsum("...ii->...i", matrix)
    return matrix + damping * diagonal[..., None] * np.eye(matrix.shape[-1])


def solve(matrix: Float[np.ndarray, "p p"], right: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Solution of symmetric positive semi-definite equations, which are scaled to a unit diagonal.

    Directions that the matrix does not determine are zero.
    """
    size = np.diag(matrix)
    # Without a unit a row is zero, and the matrix has no root.
    unit = np.where(size > _TINY, 1 / np.sqrt(np.maximum(size, _TINY)), 0.0)
    try:
        root = np.linalg.cholesky(matrix * np.outer(unit, unit))
    except np.linalg.LinAlgError:
        return np.asarray(scaled_inverse(matrix) @ right)
    half = np.linalg.solve(root, right * unit)
    return np.asarray(np.linalg.solve(root.T, half) * unit)


@final
@dataclass(frozen=True)
class Solution(Generic[Place, _Equations]):
    """Where a descent ended.

    Attributes:
        place: where the cost is lowest.
        equations: at ``place``.
        gain: expected fall of the cost by one more step; infinite where the equations are not finite.
        converged: whether ``gain`` satisfies the rules.
        history: the cost at the start and after each iteration that lowered it.
        iterations: steps that were tried.
        ahead: length of the way left, in next steps, if steps go on to shrink as the last two did.
    """

    place: Place
    equations: _Equations
    gain: float
    converged: bool
    history: tuple[float, ...]
    iterations: int
    ahead: float = 1.0

    def with_rest(self, cov: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
        """A covariance of the shared parameters, to which the way that is left to the minimum is one more error."""
        if not np.isfinite(self.gain):
            return cov
        rest = self.equations.step(0.0).shared * (1.0 if self.converged else self.ahead)
        return np.asarray(cov + np.outer(rest, rest))


def minimise(
    problem: Problem[Place, _Equations], start: Place, rules: SolverRules | None = None
) -> Solution[Place, _Equations]:
    """The minimum of the cost next to ``start``, by Levenberg-Marquardt steps.

    ``rules`` say when a descent has converged. Where the cost is not finite at the start, the start comes back, not
    converged.
    """
    rules = rules or SolverRules()
    place, here = start, problem.equations_at(start)
    gain, ahead = _gain(here), 1.0
    history, damping, raise_by, lowered, iteration = [here.cost], rules.first_damping, 2.0, np.inf, 0
    while True:
        LOG.debug("%s: iteration %d, cost %.9g, to gain %.3g", problem.name, iteration, here.cost, gain)
        enough = rules.least_gain * max(here.cost / max(here.samples, 1), 1.0)
        stalled = damping > rules.most_damping or lowered < rules.stalled_gain
        converged = bool(gain < enough or (stalled and gain < rules.small_gain))
        if converged or iteration >= rules.iterations or damping > rules.most_damping or not np.isfinite(gain):
            return Solution(place, here, gain, converged, tuple(history), iteration, ahead)
        following = None
        while following is None and iteration < rules.iterations and damping <= rules.most_damping:
            iteration += 1
            step = here.step(damping)
            tried = problem.moved(place, step)
            there = problem.equations_at(tried)
            next_gain = _gain(there) if there.cost < here.cost else np.inf
            if np.isfinite(next_gain):
                lowered, following = here.cost - there.cost, (tried, there)
                kept = lowered / max(step.gain, _TINY)
                damping, raise_by = damping * float(np.clip(1.0 - (2.0 * kept - 1.0) ** 3, 0.1, 2.0)), 2.0
            else:
                damping, raise_by = damping * raise_by, 2.0 * raise_by
        if following is not None:
            # The gain falls with the square of the step.
            shrunk = float(np.sqrt(max(next_gain, 0.0) / max(gain, _TINY)))
            ahead, gain = 1 / (1 - min(shrunk, _SLOWEST)), next_gain
            place, here = following
            history.append(here.cost)


def _gain(equations: Equations) -> float:
    """Expected fall of the cost by one undamped step; infinite where cost or equations are not finite."""
    if not np.isfinite(equations.cost):
        return np.inf
    try:
        gain = float(equations.step(0.0).gain)
    except np.linalg.LinAlgError:
        return np.inf
    return gain if np.isfinite(gain) else np.inf
