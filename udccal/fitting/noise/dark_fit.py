"""Dark noise by maximum likelihood of integer codes: black, dark current, sigma, its shape and DSNU at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import xlogy

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.least_squares import Blocks, SolverRules, Step, minimise
from udccal.fitting.noise.codes import NORMAL_SHAPE, DarkPair, Surroundings, pair_probability
from udccal.fitting.noise.rules import NoiseRules

PARAMETERS = ("black_DN", "dark_DN_per_s", "variance_DN2", "DSNU_DN2", "lambda_read")
# Variances at these are those of none: three hundredths of a code, a thousandth for the offsets.
LEAST_VARIANCE = 1e-3
_LOW = np.array([-np.inf, -np.inf, LEAST_VARIANCE, 1e-6, -0.1])
_BLACK = np.eye(5)[0]
_HIGH = np.array([np.inf, np.inf, np.inf, np.inf, 0.45])
# One-sided slopes promise a little for ever.
_SOLVER = SolverRules(least_gain=1e-3, stalled_gain=1e-4, iterations=40)


@final
@dataclass(frozen=True)
class DarkFit:
    """Values in the order of ``PARAMETERS``: variances of single samples without row noise.

    ``edge_gains`` is d(mean code)/d(black) per pair: 1 when rounding is white and no code is cut off.
    """

    values: Float[np.ndarray, "5"]
    cov: Float[np.ndarray, "5 5"]
    edge_gains: Float[np.ndarray, " pairs"]
    converged: bool
    iterations: int


@final
@dataclass(frozen=True)
class _DarkCodes:
    """The engine's problem: the deviance of all histograms from those expected, the shape's prior added."""

    pairs: tuple[DarkPair, ...]
    known: Surroundings
    free: Bool[np.ndarray, "5"]
    shape_sigma: float
    name: str = "noise, dark codes"

    def equations_at(self, place: Float[np.ndarray, "5"]) -> Blocks:
        """Score and Fisher information; at a bound with the score pointing outwards the bound is the answer."""
        off = (place[4] - NORMAL_SHAPE) / self.shape_sigma
        cost, samples, steps = off**2, 0, _steps(self.pairs, place)
        score, information = np.zeros(5), np.zeros((5, 5))
        score[4], information[4, 4] = -off / self.shape_sigma, self.shape_sigma**-2
        for pair in self.pairs:
            joint = pair_probability(pair, place, self.known)
            p, counts, total = joint.ravel(), pair.counts.ravel(), int(pair.counts.sum())
            slopes = self._slopes(pair, joint, place, steps)
            cost += 2 * float(np.sum(xlogy(counts, counts / (total * p))))
            score += slopes @ (counts / p)
            information += total * (slopes / p) @ slopes.T
            samples += total
        information = np.where(np.outer(self.free, self.free), information, 0.0)
        held = ~self.free | ((place <= _LOW) & (score < 0)) | ((place >= _HIGH) & (score > 0))
        dense = Blocks.dense(cost, samples, information, np.where(self.free, score, 0.0))
        return replace(dense, held=held)

    def moved(self, place: Float[np.ndarray, "5"], step: Step) -> Float[np.ndarray, "5"]:
        """Inside the bounds."""
        return np.clip(place + step.shared, _LOW, _HIGH)

    def _slopes(
        self,
        pair: DarkPair,
        at: Float[np.ndarray, "codes codes"],
        place: Float[np.ndarray, "5"],
        steps: Float[np.ndarray, "5"],
    ) -> Float[np.ndarray, "5 cells"]:
        """One-sided: the second order, which that leaves, sums to nothing in the score at the truth."""
        slopes = np.zeros((5, at.size))
        for i in np.flatnonzero(self.free):
            step = steps[i] if place[i] + steps[i] <= _HIGH[i] else -steps[i]
            moved = place + step * np.eye(5)[i]
            slopes[i] = (pair_probability(pair, moved, self.known) - at).ravel() / step
        return slopes


def _steps(pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"]) -> Float[np.ndarray, "5"]:
    """For slopes by differences: small beside the noise, large beside the arithmetic."""
    width = float(np.sqrt(values[2] + 0.01))
    longest = max(max(pair.exposure_s for pair in pairs), 1e-9)
    variance = 2e-3 * width**2
    return np.array([2e-3 * width, 2e-3 * width / longest, variance, max(1e-3 * values[3], 1e-4 * variance), 2e-3])


def start_values(pairs: tuple[DarkPair, ...]) -> Float[np.ndarray, "5"]:
    """Moments of the histograms: the covariance of the two codes is the variance of the offsets."""
    found = []
    for pair in pairs:
        centres, share = pair.centres_DN, pair.counts / max(pair.counts.sum(), 1)
        first, second = share.sum(axis=1), share.sum(axis=0)
        spread = float((centres - first @ centres) @ share @ (centres - second @ centres))
        total = float(first @ (centres - first @ centres) ** 2)
        found.append((pair.exposure_s, 0.5 * (first + second) @ centres, total - spread, spread))
    times, means, variances, spreads = np.array(found).T
    centred = times - times.mean()
    slope = float(centred @ means) / max(float(centred @ centred), 1e-300)
    black = float(means.mean()) - slope * float(times.mean())
    variance = max(float(variances.min()) - 1.0 / 12.0, 0.05)
    return np.array([black, slope, variance, max(float(spreads.min()), 0.003), NORMAL_SHAPE])


def fit_dark(
    pairs: tuple[DarkPair, ...],
    known: Surroundings,
    rules: NoiseRules,
    start: Float[np.ndarray, "5"] | None = None,
    normal: bool = False,
) -> DarkFit:
    """Fisher scoring on the likelihood of all pairs.

    The pairs share their pixels' offsets, so the information on DSNU does not add up over pairs: its sigma is widened
    by the square root of their number. Row noise in ``known`` is that of the population; the mean levels that decide
    black and dark current carry their own weights (see ``dark_levels``).

    Args:
        pairs: the histograms.
        known: what is known besides.
        rules: for the prior of the shape.
        start: values to begin with; moments otherwise.
        normal: hold the shape at that of normal noise.
    """
    values = np.clip(start_values(pairs) if start is None else start, _LOW, _HIGH)
    one_exposure = len({pair.exposure_s for pair in pairs}) < 2
    free = np.array([True, not one_exposure, True, True, not normal])
    values = np.where(free, values, [0.0, 0.0, 0.0, 0.0, NORMAL_SHAPE])
    found = minimise(_DarkCodes(pairs, known, free, rules.shape_sigma), values, _SOLVER)
    values = found.place
    # Noise and offsets within a code: their number may then be hidden by rounding, and else by nothing but chance.
    hidden = free & bool(values[2] + values[3] < pairs[0].step_DN ** 2)
    widen = np.sqrt(np.array([1.0, 1.0, 1.0, len(pairs), 1.0]))
    cov = scaled_inverse(_least(found.equations.shared, pairs, hidden, rules)) * np.outer(widen, widen)
    return DarkFit(values, cov, _edge_gains(pairs, values, known), found.converged, found.iterations)


def _least(
    information: Float[np.ndarray, "5 5"], pairs: tuple[DarkPair, ...], hidden: Bool[np.ndarray, "5"], rules: NoiseRules
) -> Float[np.ndarray, "5 5"]:
    """What rounding hides is no larger than rounding: that much is known of codes that are all the same."""
    step2 = pairs[0].step_DN ** 2 / 12.0
    longest = max(max(pair.exposure_s for pair in pairs), 1e-9)
    least = np.array([1 / step2, longest**2 / step2, step2**-2, step2**-2, rules.shape_sigma**-2])
    lost = hidden & (np.diag(information) < least)
    return np.where(lost[:, None] | lost, np.diag(np.where(lost, least, 0.0)), information)


def dark_levels(
    pairs: tuple[DarkPair, ...], fit: DarkFit, known: Surroundings
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Mean of each pair (censoring and rounding undone) and the variance of its temporal noise, row noise included.

    One scoring step per pair from the common fit; the offsets' share of the variance is the same in every pair and
    does not count here.
    """
    means, variances = [], []
    step = _steps(pairs, fit.values)[0]
    for pair in pairs:
        joint = pair_probability(pair, fit.values, known)
        slope = (pair_probability(pair, fit.values + step * _BLACK, known) - joint).ravel() / step
        p, total = joint.ravel(), float(pair.counts.sum())
        information = total * float((slope / p) @ slope)
        # Where all codes are one code, the level is known to rounding alone.
        blind = pair.step_DN**2 / 12.0
        seen = information * blind >= 1
        shift = float(slope @ (pair.counts.ravel() / p)) / information if seen else 0.0
        means.append(fit.values[0] + fit.values[1] * pair.exposure_s + shift)
        temporal = max(1 / information - fit.values[3] / total, 0.05 / information) if seen else blind
        variances.append(temporal + known.sigma_row_DN**2 / (2 * pair.rows) if seen else blind)
    return np.array(means), np.array(variances)


def _edge_gains(
    pairs: tuple[DarkPair, ...], values: Float[np.ndarray, "5"], known: Surroundings
) -> Float[np.ndarray, " pairs"]:
    step = 0.01 * float(np.sqrt(values[2]))
    up, down = values + step * _BLACK, values - step * _BLACK
    rises = [pair_probability(pair, up, known) - pair_probability(pair, down, known) for pair in pairs]
    return np.array([rise.sum(axis=1) @ p.centres_DN for rise, p in zip(rises, pairs, strict=True)]) / (2 * step)
