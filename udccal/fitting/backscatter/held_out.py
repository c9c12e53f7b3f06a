"""Pictures that take no part in a fit, predicted by it: what the model leaves undescribed of a new picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.fitting.backscatter.begin import Problem, solved
from udccal.fitting.backscatter.checks import SIGNIFICANT, noise_variance
from udccal.fitting.backscatter.likelihood import Fitted
from udccal.fitting.backscatter.profile import mask_slopes, predicted_variance, profiled, with_still_white, with_white
from udccal.fitting.backscatter.ratios import ratios_and_slopes, window_logs, windows_at
from udccal.fitting.backscatter.vector import Order
from udccal.fitting.engine.tails import chi2_tail

EVERY = 4


@dataclass(frozen=True)
class HeldOut:
    """How a fit without every fourth picture predicts those.

    Attributes:
        rms_of_peak: of measured less predicted light, as a share of each picture's peak.
        excess_of_peak: the same with what noise gives taken out, that of the other pictures included.
        share: what the model leaves undescribed of ratios there; 0 where not significant.
    """

    rms_of_peak: float
    excess_of_peak: float
    share: float


def held_out(problem: Problem, order: Order, full: Fitted) -> HeldOut:
    """A fit without every fourth picture, and its errors there; ``full`` is the fit with them."""
    weight = full.weight.copy()
    weight[EVERY::EVERY] = 0.0
    fitted = solved(problem, order, full.solution.x, weight)
    used = (full.weight > 0) & (weight == 0)
    if not used.any():
        return HeldOut(0.0, 0.0, 0.0)
    noise = noise_variance(fitted, problem.seen) + _prediction_variance(problem, fitted)
    light = fitted.mask * fitted.ratio
    peak = np.maximum(np.where(used, light, 0.0).max(axis=(1, 2), keepdims=True), 1e-12)
    square, expected = ((part / peak**2)[used] for part in (fitted.errors**2, noise))
    excess = float((square - expected).mean())
    # By how much pictures that come in raise chi2 is their own chi2 by the prediction's whole covariance.
    unlikely = chi2_tail(full.solution.chi2 - fitted.solution.chi2, used.sum()) < SIGNIFICANT
    unit = np.broadcast_to(fitted.mask**2, used.shape)[used]
    over = float((fitted.errors**2 - noise)[used].sum() / max(unit.sum(), 1e-30))
    return HeldOut(
        float(np.sqrt(square.mean())), float(np.sqrt(max(excess, 0.0))), float(np.sqrt(max(over, 0.0)) * unlikely)
    )


def _prediction_variance(problem: Problem, fitted: Fitted) -> Float[np.ndarray, "shots 3 n"]:
    """Of light predicted by a fit, by what the fit does not know of parameters and masks."""
    seen, x = problem.seen, fitted.solution.x
    at = windows_at(problem.template.window, seen.rays, fitted.corner, seen.shown)
    ratio, slope = ratios_and_slopes(problem.template, x, at, window_logs(at, seen.shown))
    ratio, slope = with_white(ratio), with_still_white(slope)
    best = profiled(ratio, seen, fitted.weight)
    by_mask = mask_slopes(ratio, slope, best, seen, fitted.weight)
    return predicted_variance(ratio, slope, best, by_mask, fitted.solution.cov)
