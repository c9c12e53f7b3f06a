"""The optimiser. jaxopt stands behind this one module; a successor would touch this file only."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udccal.fitting.engine.iteration_log import LOG
from udccal.numerics import in_float64

with warnings.catch_warnings():
    # jaxopt says on import that it is no longer developed; it is complete for what is used here.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt

_STEPS = 40
_DAMPING, _MOST = 1e-6, 1e8
# Converged when another step would lower chi2 by less than this, in units of the residual variance where that is above
# 1: a hundredth of a sigma.
_LEFT_TO_GAIN = 1e-4
# A residual that stands for larger ones and for those that are not finite: no step is worse, and its cube is a number.
_WORST = 1e30

# Parameters to whitened errors and their slopes.
Linearised = Callable[[Float[np.ndarray, " n"]], tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]]


@dataclass(frozen=True)
class Solution:
    """Minimiser of |r(x)|^2 with the covariance (J^T J)^-1, valid when residuals are in units of their sigma.

    ``history`` is chi2 at the start and after each iteration. Where the residuals are not finite at the start, ``x`` is
    the start and ``converged`` is False.
    """

    x: Float[np.ndarray, " n"]
    cov: Float[np.ndarray, "n n"]
    chi2: float
    iterations: int
    converged: bool
    history: Float[np.ndarray, " iterations_plus_1"]


@in_float64
def most_probable(
    errors_at: Linearised,
    start: Float[np.ndarray, " n"],
    free: Bool[np.ndarray, " n"],
    mean: Float[np.ndarray, " n"],
    sigma: Float[np.ndarray, " n"],
) -> Solution:
    """Levenberg-Marquardt on |errors|^2 + |(x - mean) / sigma|^2 over the free parameters, in float64.

    The covariance is that of the free parameters, the prior's information included; rows and columns of the others are
    0.

    Args:
        errors_at: errors in units of their sigma, and their slopes, worked out beside them.
        start: where to begin.
        free: parameters that are not held at their start.
        mean, sigma: the prior's.
    """
    problem = _Problem(errors_at, start, np.where(free, sigma, 0.0), (start - mean) / sigma)
    begun = errors_at(start)
    first = problem.triangle(np.zeros(len(start)), *begun)
    if not np.abs(first).max() < _WORST:
        nothing = np.zeros((len(start), len(start)))
        return Solution(start, nothing, np.inf, 0, False, np.array([np.inf]))
    problem = replace(problem, unit=1 / np.linalg.norm(first[:, :-1], axis=0))
    first[:, :-1] *= problem.unit
    solver = jaxopt.LevenbergMarquardt(
        _seen_by_jax(problem, first), damping_parameter=_DAMPING, materialize_jac=True, solver="cholesky", jit=False
    )
    z = jnp.zeros(len(start))
    state = solver.init_state(z)
    history, converged = [2 * float(state.value)], False
    for step in range(_STEPS):
        LOG.debug("%s: iteration %d, chi2 %.9g", errors_at.__qualname__, step, history[-1])
        gradient = np.asarray(state.gradient)
        gain = float(gradient @ np.linalg.solve(np.asarray(state.jtj), gradient))
        # Where damping is at its end, no step, however small, lowers chi2: the arithmetic's last digit.
        stalled = float(state.damping_factor) > _MOST
        enough = _LEFT_TO_GAIN * max(history[-1] / len(begun[0]), 1.0) * (100 if stalled else 1)
        converged = gain < enough
        if converged or stalled:
            break
        z, state = solver.update(z, state)
        history.append(2 * float(state.value))
    step_size = problem.unit * problem.sigma
    cov = np.linalg.inv(np.asarray(state.jtj)) * np.outer(step_size, step_size)
    return Solution(problem.place(np.asarray(z)), cov, history[-1], len(history) - 1, converged, np.array(history))


@dataclass(frozen=True)
class _Problem:
    """Errors and prior in coordinates z in which the start is 0 and one ``unit`` is about one sigma.

    ``sigma`` is the prior's, 0 for parameters that are held; ``off`` is how far the start is from its mean, in sigma.
    """

    errors_at: Linearised
    start: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    off: Float[np.ndarray, " n"]
    unit: Float[np.ndarray, " n"] | float = 1.0

    def place(self, z: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Parameters at z."""
        return np.asarray(self.start + self.sigma * self.unit * z)

    def triangle(
        self, z: Float[np.ndarray, " n"], errors: Float[np.ndarray, " m"], slopes: Float[np.ndarray, "m n"]
    ) -> Float[np.ndarray, "n_1 n_1"]:
        """Triangular factor of slopes and errors side by side: the same sums of squares and products in few rows.

        However many samples there are, the solver is compiled for one shape. NaN where something is not finite.
        """
        free = self.sigma > 0
        prior = np.where(free, self.off + self.unit * z, 0.0)
        by_z = np.concatenate([slopes * self.sigma * self.unit, np.diag(np.full(len(z), self.unit))])
        both = np.column_stack([by_z, np.concatenate([errors, prior])])
        if not np.isfinite(both).all():
            return np.full((len(z) + 1, len(z) + 1), np.nan)
        return np.asarray(np.linalg.qr(both, mode="r"))


def _seen_by_jax(problem: _Problem, first: Float[np.ndarray, "n_1 n_1"]) -> Callable[[Array], Array]:
    """The residuals as jaxopt asks for them: with slopes that are worked out beside them, not traced.

    ``first`` is the triangle at the start.
    """
    last = [(np.zeros(len(first) - 1).tobytes(), first)]

    def at(z: Array) -> tuple[Array, Array]:
        place = np.asarray(z)
        if last[0][0] != place.tobytes():
            found = problem.triangle(place, *problem.errors_at(problem.place(place)))
            if not np.abs(found).max() < _WORST:
                found = np.zeros_like(found)
                found[:, -1] = _WORST
            last[:] = [(place.tobytes(), found)]
        return jnp.asarray(last[0][1][:, -1]), jnp.asarray(last[0][1][:, :-1])

    @jax.custom_jvp
    def residuals(z: Array) -> Array:
        return at(z)[0]

    @residuals.defjvp
    def _(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
        errors, slopes = at(primals[0])
        return errors, slopes @ tangents[0]

    return residuals
