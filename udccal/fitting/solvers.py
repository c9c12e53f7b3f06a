"""The optimisers. jaxopt stands behind this one module; a successor would touch this file only."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.numerics import in_float64

with warnings.catch_warnings():
    # jaxopt says on import that it is no longer developed; it is complete for what is used here.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt


@dataclass(frozen=True)
class Solution:
    """Minimiser of 0.5 |r(x)|^2 with the covariance (J^T J)^-1, valid when residuals are in units of their sigma."""

    x: Float[np.ndarray, " n"]
    cov: Float[np.ndarray, "n n"]
    chi2: float
    residuals: Float[np.ndarray, " m"]
    iterations: int
    converged: bool


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
        residuals: pure JAX function returning whitened residuals (unit variance each).
        start: starting values, length n.
        scale: typical size of each parameter's uncertainty; the solver sees (x - start) / scale.
        max_iterations: upper bound.
        tolerance: on the relative decrease of chi2 and on the step in units of ``scale``.
    """
    origin = jnp.asarray(start, dtype=jnp.float64)
    unit = jnp.asarray(scale, dtype=jnp.float64)

    def scaled(z: Array, *rest: Any) -> Array:
        return residuals(origin + unit * z, *rest)

    solver = jaxopt.LevenbergMarquardt(scaled, maxiter=max_iterations, tol=tolerance, xtol=tolerance, gtol=tolerance)
    state = solver.run(jnp.zeros_like(origin), *args)
    z = state.params
    r = scaled(z, *args)
    jacobian = np.asarray(jax.jacfwd(scaled)(z, *args))
    cov = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    step = np.asarray(unit)
    iterations = int(state.state.iter_num)
    return Solution(
        x=np.asarray(origin + unit * z),
        cov=cov * np.outer(step, step),
        chi2=float(r @ r),
        residuals=np.asarray(r),
        iterations=iterations,
        converged=bool(np.all(np.isfinite(np.asarray(z)))) and iterations < max_iterations,
    )


@in_float64
def ridge(
    design: Float[np.ndarray, "m n"],
    data: Float[np.ndarray, " m"],
    weights: Float[np.ndarray, " m"],
    penalty: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Weighted linear least squares with a diagonal quadratic penalty; returns the solution and its covariance.

    ``weights`` are inverse variances; ``penalty`` is an inverse prior variance per parameter (0: none).
    """
    weighted = design * weights[:, None]
    normal = design.T @ weighted + np.diag(penalty)
    cov = np.linalg.pinv(normal, hermitian=True)
    return cov @ (weighted.T @ data), cov
