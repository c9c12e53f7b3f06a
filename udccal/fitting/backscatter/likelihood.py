"""Likelihood of the backscatter term: every picture's light in every bin with its own variance.

Light of shot i at a position and colour is  y_i = m r_i + u_i d + noise: r_i is the picture's light over that of white
(1 for white itself), m the mask and d the dark signal there, u_i 1 where shot and dark have one exposure. The dark
frame is one more shot with r = 0. m and d stand in no prior and enter linearly: they are profiled out exactly, bin by
bin, so that the noise of white and dark, which all pictures of a bin share, is weighed as it should be. Variances are
of the model, shot noise and what is left in the dark, plus (share m)^2 for what the model does not describe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.backscatter.evidence import Evidence
from udccal.fitting.backscatter.profile import profiled, whitened, with_still_white, with_white
from udccal.fitting.backscatter.ratios import Windows, ratios, ratios_and_slopes, window_logs, windows_at
from udccal.fitting.backscatter.vector import Order, Prior
from udccal.fitting.solvers import Linearised, Solution, most_probable
from udccal.models.backscatter import Backscatter


@dataclass(frozen=True)
class Fitted:
    """Parameters and what follows from them at the sampled positions.

    ``errors`` are measured less modelled rates, ``weight`` 1 / sigma of each (0: not used).
    """

    solution: Solution
    corner: Int[np.ndarray, "n 2"]
    ratio: Float[np.ndarray, "shots 3 n"]
    mask: Float[np.ndarray, "3 n"]
    errors: Float[np.ndarray, "shots 3 n"]
    dark_errors: Float[np.ndarray, "3 n"]
    weight: Float[np.ndarray, "shots 3 n"]

    @property
    def z(self) -> Float[np.ndarray, "shots 3 n"]:
        """Errors in units of their sigma, 0 where not used."""
        return self.errors * self.weight


def linearised(
    x: Float[np.ndarray, "18"],
    template: Backscatter,
    at: Windows,
    seen: Evidence,
    weight: Float[np.ndarray, "shots 3 n"],
    logs: Float[np.ndarray, "n 3 pictures window2"],
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]:
    """Whitened errors at ``x`` and their slopes; ``logs`` is of ``window_logs``."""
    ratio, slope = ratios_and_slopes(template, x, at, logs)
    errors, by_ratio = whitened(with_white(ratio), with_still_white(slope), seen, weight)
    return errors.ravel(), by_ratio.reshape(len(by_ratio), -1).T


def errors_of(
    template: Backscatter, seen: Evidence, weight: Float[np.ndarray, "shots 3 n"], corner: Int[np.ndarray, "n 2"]
) -> Linearised:
    """Whitened errors and their slopes as a function of the parameters, with windows from these corners on."""
    at = windows_at(template.window, seen.rays, corner, seen.shown)
    logs = window_logs(at, seen.shown)

    def errors_at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return linearised(x, template, at, seen, weight, logs)

    return errors_at


def solve(
    template: Backscatter,
    seen: Evidence,
    weight: Float[np.ndarray, "shots 3 n"],
    order: Order,
    prior: Prior,
    start: Float[np.ndarray, "18"],
    corner: Int[np.ndarray, "n 2"],
) -> Fitted:
    """The most probable parameters of an order at given weights; ``corner`` is the window of each position."""
    errors_at = errors_of(template, seen, weight, corner)
    solution = most_probable(errors_at, order.start(start, prior), order.free > 0, prior.mean, prior.sigma)
    return fitted_at(template, seen, weight, solution, corner)


def fitted_at(
    template: Backscatter,
    seen: Evidence,
    weight: Float[np.ndarray, "shots 3 n"],
    solution: Solution,
    corner: Int[np.ndarray, "n 2"],
) -> Fitted:
    """A solution with its mask and errors at given weights."""
    at = windows_at(template.window, seen.rays, corner, seen.shown)
    return reweighed(solution, corner, with_white(ratios(template, solution.x, at, seen.shown)), seen, weight)


def reweighed(
    solution: Solution,
    corner: Int[np.ndarray, "n 2"],
    ratio: Float[np.ndarray, "shots 3 n"],
    seen: Evidence,
    weight: Float[np.ndarray, "shots 3 n"],
) -> Fitted:
    """A solution whose ratios are known with its mask and errors at given weights."""
    best = profiled(ratio, seen, weight)
    errors = seen.light - best.mask * ratio - seen.exposure[:, None, None] * best.dark
    return Fitted(solution, corner, ratio, best.mask, errors, seen.dark - best.dark, weight)


def chi2_of(fitted: Fitted, seen: Evidence) -> float:
    """Sum of squared errors in sigma, of shots and dark, the prior left out."""
    return float((fitted.z**2).sum() + (fitted.dark_errors**2 / seen.dark_variance).sum())


def degrees_of_freedom(weight: Float[np.ndarray, "shots 3 n"], parameters: float) -> float:
    """Samples less one mask per bin (the dark signal has a sample of its own) less parameters."""
    used = weight > 0
    return max(float(used.sum() - used.any(axis=0).sum()) - parameters, 1.0)
