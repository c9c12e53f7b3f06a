"""Levenberg-Marquardt with a normal prior, for errors whose slopes are worked out beside them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.iteration_log import LOG
from udccal.fitting.solvers import Solution
from udccal.numerics import in_float64

_STEPS = 30
_DAMPING, _LEAST, _MOST = 1e-3, 1e-9, 1e9
# Converged when another step would lower chi2 by less than this, in units of the residual variance where that is above
# 1: a hundredth of a sigma.
_LEFT_TO_GAIN = 1e-4

# Parameters to whitened errors and their slopes.
Linearised = Callable[[Float[np.ndarray, " n"]], tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"]]]


@in_float64
def most_probable(
    errors_at: Linearised,
    start: Float[np.ndarray, " n"],
    free: Bool[np.ndarray, " n"],
    mean: Float[np.ndarray, " n"],
    sigma: Float[np.ndarray, " n"],
) -> Solution:
    """Minimise |errors|^2 + |(x - mean) / sigma|^2 over the free parameters.

    Where errors are not finite at the start, the start comes back as not converged. The covariance is that of the
    free parameters, the prior's information included; rows and columns of the others are 0.
    """
    x, damping = start.copy(), _DAMPING
    chi2, gradient, normal, errors = _system(errors_at, x, free, mean, sigma)
    history = [chi2]
    converged = False
    for step in range(_STEPS):
        if not np.isfinite(chi2):
            break
        LOG.debug("backscatter: iteration %d, chi2 %.9g", step, chi2)
        gain = float(gradient @ np.linalg.solve(normal, gradient))
        enough = _LEFT_TO_GAIN * max(chi2 / len(errors), 1.0)
        if converged := gain < enough:
            break
        trial = x.copy()
        trial[free] -= np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient) * sigma[free]
        found = _system(errors_at, trial, free, mean, sigma)
        history.append(found[0] if np.isfinite(found[0]) else chi2)
        if np.isfinite(found[0]) and found[0] < chi2:
            x, (chi2, gradient, normal, errors) = trial, found
            damping = max(damping / 10, _LEAST)
        elif damping > _MOST:
            # The arithmetic's last digit: no step, however small, lowers chi2 any more.
            converged = gain < 100 * enough
            break
        else:
            damping *= 10
    cov = np.zeros((len(x), len(x)))
    if np.isfinite(chi2):
        cov[np.ix_(free, free)] = np.linalg.inv(normal) * np.outer(sigma[free], sigma[free])
    return Solution(x, cov, chi2, errors, len(history) - 1, converged, np.array(history))


def _system(
    errors_at: Linearised,
    x: Float[np.ndarray, " n"],
    free: Bool[np.ndarray, " n"],
    mean: Float[np.ndarray, " n"],
    sigma: Float[np.ndarray, " n"],
) -> tuple[float, Float[np.ndarray, " f"], Float[np.ndarray, "f f"], Float[np.ndarray, " m"]]:
    """chi2 with the prior's part, half its gradient and the normal matrix, parameters in units of the prior's sigma."""
    errors, slopes = errors_at(x)
    slopes = slopes[:, free] * sigma[free]
    off = ((x - mean) / sigma)[free]
    normal = slopes.T @ slopes + np.eye(int(free.sum()))
    if not np.isfinite(normal).all():
        return np.inf, np.zeros(len(off)), np.eye(len(off)), np.zeros_like(errors)
    return float(errors @ errors + off @ off), slopes.T @ errors + off, normal, errors
