"""The optimisers. jaxopt stands behind this one module; a successor would touch this file only."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.fitting.iteration_log import LOG
from udccal.numerics import in_float64

with warnings.catch_warnings():
    # jaxopt says on import that it is no longer developed; it is complete for what is used here.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt

# A fit has converged when another step would lower chi2 by less than this, in units of the residual variance.
_LEFT_TO_GAIN = 1e-3


@dataclass(frozen=True)
class Solution:
    """Minimiser of 0.5 |r(x)|^2 with the covariance (J^T J)^-1, valid when residuals are in units of their sigma.

    ``history`` is chi2 at the start and after each iteration. Where the residuals stopped being finite on the way,
    ``x`` is the start and ``converged`` is False.
    """

    x: Float[np.ndarray, " n"]
    cov: Float[np.ndarray, "n n"]
    chi2: float
    residuals: Float[np.ndarray, " m"]
    iterations: int
    converged: bool
    history: Float[np.ndarray, " iterations_plus_1"]


@in_float64
def least_squares(
    residuals: Callable[..., Float[Array, " m"]],
    start: Float[np.ndarray, " n"],
    scale: Float[np.ndarray, " n"],
    *args: Any,
    max_iterations: int = 60,
    tolerance: float = 1e-10,
) -> Solution:
    """Levenberg-Marquardt on ``residuals(x, *args)`` in float64.

    Args:
        residuals: pure JAX function at module scope returning whitened residuals (unit variance each); what it needs
            comes in ``args`` (arrays or pytrees of arrays), so that it is compiled once per shape.
        start: starting values, length n.
        scale: typical size of each parameter's uncertainty; the solver sees (x - start) / scale.
        max_iterations: upper bound.
        tolerance: on the relative decrease of chi2 and on the step in units of ``scale``.
    """
    origin = np.asarray(start, dtype=np.float64)
    unit = np.asarray(scale, dtype=np.float64)
    solve = _compiled(residuals, max_iterations, tolerance)
    z, steps, r, jacobian, trace = (np.asarray(part) for part in solve(origin, unit, args))
    history = trace[: int(steps) + 1]
    _log(residuals, history)
    if not (np.isfinite(z).all() and np.isfinite(r).all() and np.isfinite(jacobian).all()):
        r = np.asarray(residuals(jnp.asarray(origin), *args))
        r = np.where(np.isfinite(r), r, 0.0)
        nothing = np.zeros((len(origin), len(origin)))
        return Solution(origin, nothing, float(r @ r), r, int(steps), False, history)
    cov = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    return Solution(
        x=origin + unit * z,
        cov=cov * np.outer(unit, unit),
        chi2=float(r @ r),
        residuals=r,
        iterations=int(steps),
        converged=_at_minimum(jacobian.T @ r, cov, r),
        history=history,
    )


def _log(residuals: Callable[..., Array], history: Float[np.ndarray, " iterations_plus_1"]) -> None:
    name = f"{residuals.__module__}.{residuals.__qualname__}"
    for iteration, chi2 in enumerate(history):
        LOG.debug("%s: iteration %d, chi2 %.9g", name, iteration, chi2)


def _at_minimum(
    gradient: Float[np.ndarray, " n"], cov: Float[np.ndarray, "n n"], residuals: Float[np.ndarray, " m"]
) -> bool:
    """Whether another Newton step, which gains gradient^T cov gradient, would still lower chi2 noticeably.

    A solver that stalls at the limit of its arithmetic passes; one that ran out of iterations on the way does not.
    """
    gain = float(gradient @ cov @ gradient)
    return bool(np.isfinite(gain)) and gain < _LEFT_TO_GAIN * max(float(np.mean(residuals**2)), 1e-12)


@functools.lru_cache(maxsize=32)
def _compiled(
    residuals: Callable[..., Array], max_iterations: int, tolerance: float
) -> Callable[[np.ndarray, np.ndarray, tuple[Any, ...]], tuple[Array, Array, Array, Array, Array]]:
    """One solver per residual function: candidates and restarts of the same shapes then share its compilation."""

    def scaled(z: Array, origin: Array, unit: Array, args: tuple[Any, ...]) -> Array:
        return residuals(origin + unit * z, *args)

    solver = jaxopt.LevenbergMarquardt(
        scaled, maxiter=max_iterations, tol=tolerance, xtol=tolerance, gtol=tolerance, materialize_jac=True
    )

    @jax.jit
    def solve(origin: Array, unit: Array, args: tuple[Any, ...]) -> tuple[Array, Array, Array, Array, Array]:
        def unfinished(carry: tuple[Any, ...]) -> Array:
            _, state, _ = carry
            return (state.error > tolerance) & (state.iter_num < max_iterations)

        def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
            z, state, trace = carry
            z, state = solver.update(z, state, origin, unit, args)
            return z, state, trace.at[state.iter_num].set(2 * state.value)

        z = jnp.zeros_like(origin)
        first = solver.init_state(z, origin, unit, args)
        trace = jnp.zeros(max_iterations + 1, first.value.dtype).at[0].set(2 * first.value)
        z, state, trace = jax.lax.while_loop(unfinished, step, (z, first, trace))
        # The state's residuals and slopes are those at the solution: to ask again would be to compile them again.
        return z, state.iter_num, state.residual, state.jac, trace

    return solve
