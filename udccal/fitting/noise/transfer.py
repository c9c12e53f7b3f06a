"""Photon transfer and response at once: gain K, read noise V0, curvature by maximum likelihood (EMVA 1288, clause 6).

The sensor turns a linear signal z (DN above black) into y = z - c z^2 - d z^3: c and d are 0 for a linear one. The mean
over shot noise holds the means of z^2 and z^3 (``response``); in a bin whose light has the relative variance v, these
are (1 + v) and (1 + 3 v) times the square and the cube of its mean. Then, for one pixel,

    temporal variance = (K z + g^2 z^2) (1 - 2 c z - 3 d z^2)^2 + V0 + q^2/12,     light part of z = A (u + u0),

with u the relative exposure to light. The gain noise g, 0 of most sensors, is noise in proportion to a pixel's signal
that is new in every frame. Sample variances are chi-squared: their weights come from the model, not from the
data. Both relations determine c and d; where the light is unsteady, which is one of the orders, only the first does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.least_squares import Blocks, Step, minimise
from udccal.fitting.engine.misfit import MisfitTest, chi2_test, excess_variance
from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.engine.robust import OutlierRule
from udccal.fitting.noise.data import NoiseRules
from udccal.fitting.noise.response import linear_mean, temporal_variance

Grid = Float[np.ndarray, "levels bins"]
PerLevel = Float[np.ndarray, " levels"]
PerDatum = Float[np.ndarray, " data"]
# K [DN/e], V0 [DN^2], curvature [1/DN], response [DN per light], offset of the light, square of the gain noise, and the
# curvature's growth with the signal [1/DN^2].
Seven = Float[np.ndarray, "7"]


# Gain noise of fewer sigma is no candidate.
_LEAST_GAIN_NOISE = 3.0
# Largest growth of the curvature over the square of the largest curvature.
_CUBIC = 2.5


@final
@dataclass(frozen=True)
class Levels:
    """Bright exposures, already reduced: one row per level, one column per bin (CFA site x tile).

    ``mean_DN`` is above black, ``variance_DN2`` temporal with ``dof``, ``samples`` are frames times pixels, ``usable``
    are bins safely inside the range of the sensor, ``uneven2`` is the relative variance of the light of a bin's pixels,
    and ``light`` the relative exposure to light, nan where unknown. ``dark_DN`` is each level's dark signal, and
    ``row_variance_DN2`` the variance of its mean by row noise and black.
    """

    mean_DN: Grid
    variance_DN2: Grid
    dof: Grid
    samples: Grid
    usable: Bool[np.ndarray, "levels bins"]
    uneven2: Grid
    light: PerLevel
    dark_DN: PerLevel
    row_variance_DN2: PerLevel

    @property
    def responding(self) -> Bool[np.ndarray, " levels"]:
        """Levels whose brightness counts for the response."""
        seen = self.usable.any(axis=1) & np.isfinite(self.light)
        # Levels of one exposure differ by the lamp's power, which was not measured.
        return np.asarray(seen & bool(seen.sum() > 2 and np.ptp(self.light[seen]) > 0))


@final
@dataclass(frozen=True)
class DarkVariance:
    """V0 by dark frames: estimates with their standard deviations; and the rounding to add.

    They hold for the gain ``K_DN_per_e``, and change with it by the shot noise of their dark signal ``drift_DN``.
    """

    V0_DN2: Float[np.ndarray, " points"]
    sigma_DN2: Float[np.ndarray, " points"]
    rounding_DN2: float
    K_DN_per_e: float
    drift_DN: Float[np.ndarray, " points"]


@final
@dataclass(frozen=True)
class Order:
    """Which parts are free: curvature, its growth, offset of the exposures, light that differs by level, gain noise."""

    curved: bool = False
    offset: bool = False
    unsteady: bool = False
    gain_noise: bool = False
    cubic: bool = False

    @property
    def name(self) -> str:
        """For the table of candidates."""
        offset, unsteady = ", exposure offset" * self.offset, ", unsteady light" * self.unsteady
        bend = "cubic" if self.cubic else "curved" if self.curved else "linear"
        return f"response: {bend}{offset}{unsteady}{', gain noise' * self.gain_noise}"

    @property
    def free(self) -> Bool[np.ndarray, "7"]:
        """Which of the seven parameters."""
        return np.array([True, True, self.curved, True, self.offset, self.gain_noise, self.cubic])


@final
@dataclass(frozen=True)
class TransferFit:
    """One order: values, covariance, relative scatter of the light by level, and residuals in sigma (nan: unused).

    ``misfit`` tells whether the variances scatter by more than noise, ``samples`` how many data there are, ``at_bound``
    whether the response would bend more than it may.
    """

    order: Order
    values: Seven
    cov: Float[np.ndarray, "7 7"]
    scatter: float
    converged: bool
    variance_z: Grid
    level_z: PerLevel
    misfit: MisfitTest
    samples: int
    at_bound: bool


@final
@dataclass(frozen=True)
class TransferProblem:
    """The solver's problem: deviance from the model; the curvature's bound, and scales of the parameters for steps.

    Its data are the usable variances, the estimates of V0, and how much less light the responding levels have than the
    model, which should be 0.
    """

    levels: Levels
    dark: DarkVariance
    order: Order
    bound: float
    sizes: Seven
    name: str = "noise, photon transfer"

    @property
    def cubic_bound(self) -> float:
        """Of the curvature's growth: with both at their bounds the response still rises at full scale."""
        return _CUBIC * self.bound**2

    @property
    def observed(self) -> PerDatum:
        """The data."""
        lacking = np.zeros(int(self.levels.responding.sum()))
        return np.concatenate([self.levels.variance_DN2[self.levels.usable], self.dark.V0_DN2, lacking])

    def predicted(self, x: Seven) -> PerDatum:
        """The data by the model."""
        K, V0, c, gain, offset, noise2, d = x
        levels, dark, mean_square = self.levels, self.dark, 1 + self.levels.uneven2
        c, d = c * mean_square, d * (1 + 3 * self.levels.uneven2)
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.where(levels.usable, levels.mean_DN, 0.0)
            signal = np.nan_to_num(linear_mean(mean, c, d, K / mean_square), posinf=0.0)
            variance = temporal_variance(signal, K, V0, c, dark.rounding_DN2, noise2 * mean_square, d)[levels.usable]
            bright = _brightness(signal - levels.dark_DN[:, None], levels.usable) / (gain * (levels.light + offset))
        variance = np.maximum(variance, 1e-9)
        return np.concatenate([variance, V0 + (K - dark.K_DN_per_e) * dark.drift_DN, (1 - bright)[levels.responding]])

    def variances(self, predicted: PerDatum) -> tuple[PerDatum, float]:
        """Of the data, and the maximum-likelihood part of the light's relative variance that is no noise."""
        of, use = self.levels, self.levels.usable
        count, bins = np.maximum(use.sum(axis=1), 1), np.count_nonzero(use)
        mean = np.where(use, of.mean_DN, 0.0).sum(axis=1) / count
        noise = np.where(use, of.variance_DN2 / of.samples, 0.0).sum(axis=1) / count**2 + of.row_variance_DN2
        known = (noise / np.maximum(mean, 1e-9) ** 2)[of.responding]
        lacking = predicted[len(predicted) - len(known) :]
        own = excess_variance(lacking**2, known, np.ones(len(known)))[0] if self.order.unsteady else 0.0
        return np.concatenate([2 * predicted[:bins] ** 2 / of.dof[use], self.dark.sigma_DN2**2, known + own]), own

    def equations_at(self, place: Seven) -> Blocks:
        """Score and Fisher information; the scatter of the light is the maximum-likelihood one at this place."""
        predicted, dof, seen = self.predicted(place), self.levels.dof[self.levels.usable], self.levels.responding.sum()
        variances, _ = self.variances(predicted)
        off, bins, jacobian = self.observed - predicted, len(dof), np.zeros((len(predicted), 7))
        # Free parameters are those of the order that the data determine.
        free = self.order.free & np.array([True, True, True, seen > 0, seen > 0, True, True])
        for i in np.flatnonzero(free):
            step = 1e-4 * self.sizes[i] * np.eye(7)[i]
            jacobian[:, i] = (self.predicted(place + step) - self.predicted(place - step)) / (2 * step[i])
        ratio = np.maximum(self.observed[:bins] / predicted[:bins], 1e-12)
        cost = float(np.sum(dof * (ratio - 1 - np.log(ratio))) + np.sum(np.log(variances[len(off) - seen :])))
        cost += float(np.sum((off**2 / variances)[bins:]))
        score, information = jacobian.T @ (off / variances), jacobian.T @ (jacobian / variances[:, None])
        held = ~free
        for bend, most in ((2, self.bound), (6, self.cubic_bound)):
            held[bend] |= abs(place[bend]) >= most and score[bend] * place[bend] > 0
        held[5] |= place[5] <= 0 and score[5] < 0
        return replace(Blocks.dense(cost, len(off), information, score), held=held)

    def moved(self, place: Seven, step: Step) -> Seven:
        """The place after a step, with curvatures inside their bounds and no negative square."""
        most = np.array([np.inf, np.inf, self.bound, np.inf, np.inf, np.inf, self.cubic_bound])
        return np.clip(place + step.shared, [*-most[:5], 0.0, -most[6]], most)

    def attempt(self, start: Seven) -> Attempt[TransferFit]:
        """The fit of the order."""
        order, use, samples = self.order, self.levels.usable, int(self.levels.dof[self.levels.usable].sum())
        found = minimise(self, np.where(order.free, start, 0.0))
        predicted = self.predicted(found.place)
        variances, own = self.variances(predicted)
        z, bins = (self.observed - predicted) / np.sqrt(variances), np.count_nonzero(use)
        variance_z, level_z = np.full(use.shape, np.nan), np.full(len(use), np.nan)
        variance_z[use], level_z[self.levels.responding] = z[:bins], np.nan_to_num(z[bins + len(self.dark.V0_DN2) :])
        misfit = chi2_test(float(np.sum(z[:bins] ** 2)), max(bins - 1.0, 1.0))
        parameters, cov = int(order.free.sum()) - 3 + order.unsteady, found.with_rest(found.equations.cov())
        # A small gain noise is as good as none, and K far less certain beside it.
        seen = not order.gain_noise or found.place[5] > _LEAST_GAIN_NOISE * cov[5, 5] ** 0.5
        criterion = bic(found.equations.cost, float(parameters), samples) if found.converged and seen else np.inf
        numbers, residuals = (found.place, cov, float(np.sqrt(own)), found.converged), (variance_z, level_z)
        bent_too_far = bool(np.any(np.abs(found.place[[2, 6]]) >= 0.999 * np.array([self.bound, self.cubic_bound])))
        fit = TransferFit(order, *numbers, *residuals, misfit, samples, bent_too_far)
        return Attempt(order.name, parameters, criterion, fit)


def _brightness(light_DN: Grid, usable: np.ndarray) -> PerLevel:
    """Mean light of each level as if every bin were usable in it: all levels have one pattern of bins."""
    complete = np.asarray(usable.all(axis=1))
    # The alternation starts from the pattern of the complete levels; without them its first rounds would be rough.
    pattern = light_DN[complete].sum(axis=0) if complete.any() else np.ones(usable.shape[1])
    seen, pattern = np.where(usable, light_DN, 0.0), pattern / max(float(pattern.mean()), 1e-9)
    for _ in range(6 if usable[~complete].any() else 1):
        level = seen.sum(axis=1) / np.maximum(usable @ pattern, 1e-9)
        weight = level**2 @ usable
        pattern = np.where(weight > 0, level @ seen / np.maximum(weight, 1e-12), 1.0)
        pattern /= max(float(pattern.mean()), 1e-9)
    return np.asarray(level)


def choose_transfer(levels: Levels, dark: DarkVariance, full_DN: float, rules: NoiseRules) -> Choice[TransferFit]:
    """The order with the least BIC, its fit, and the criterion of every order; at least one bin is usable."""
    # A straight line with rough weights, and the response through the origin.
    use, light = levels.usable, np.nan_to_num(levels.light)
    V0 = float(np.average(dark.V0_DN2, weights=1 / dark.sigma_DN2**2))
    shot = levels.variance_DN2[use] - V0 - dark.rounding_DN2
    K = float(np.median(shot / np.maximum(levels.mean_DN[use], 1e-9)))
    gain = float(light @ _brightness(levels.mean_DN - levels.dark_DN[:, None], use)) / max(float(light @ light), 1e-30)
    start = np.array([K, V0, 0.0, gain if gain > 0 else 1.0, 0.0, 0.0, 0.0])
    # A variance and the mean of its bin have correlated errors for Poisson counts, and independent ones for read noise.
    variance, q2 = np.maximum(levels.variance_DN2, 1e-9), 12 * dark.rounding_DN2
    apart = K**2 * max(V0, 0.0) / levels.samples / variance**2
    # Variances of rounded codes differ from noise plus q^2/12 (Widrow and Kollar, 2008) by the first harmonic, whose
    # phase is the mean's place between two codes: all bins of a level share it.
    noise = np.maximum(levels.variance_DN2 / q2 - 1 / 12, 0.0)
    most = q2 * (1 / np.pi**2 + 4 * noise) * np.exp(-2 * np.pi**2 * noise)
    apart += 0.5 * (most / variance) ** 2 * use.sum(axis=1, keepdims=True)
    levels = replace(levels, dof=levels.dof / (1 + 0.5 * levels.dof * apart))
    scales = 1e-9, dark.rounding_DN2 + 1e-3, 0.1 / full_DN, 1e-9, max(light.max(), 1e-30), (abs(K) + 1e-9) / full_DN
    sizes = np.abs(start) + np.array([*scales, 0.1 / full_DN**2])
    simplest = TransferProblem(levels, dark, Order(), rules.most_bent / full_DN, sizes)
    first = simplest.attempt(start)
    # The other orders start from the simplest one.
    start = first.fit.values if first.fit.converged else start
    others = [Order(curved, offset, unsteady) for unsteady, offset, curved in product((False, True), repeat=3)][1:]
    others = others if levels.responding.any() else [Order(curved=True)]
    tried = [first, *(replace(simplest, order=order).attempt(start) for order in others)]
    # A bend that is no parabola shows as a parabola, as an offset or as unsteady light.
    if (simple := choose(tried).best.fit.order) != Order():
        bends = [replace(simple, curved=True, cubic=True)]
        if levels.responding.any():
            bends += [Order(curved=True, offset=offset, cubic=True) for offset in (False, True)]
        tried += [replace(simplest, order=order).attempt(start) for order in dict.fromkeys(bends)]
    # Gain noise that is left out bends the response, or makes the light unsteady, if it does anything.
    beside = dict.fromkeys([Order(), Order(curved=True), choose(tried).best.fit.order])
    noisy = (replace(simplest, order=replace(order, gain_noise=True)).attempt(start) for order in beside)
    return choose([*tried, *noisy])


def robust_transfer(
    levels: Levels, dark: DarkVariance, full_DN: float, rules: NoiseRules
) -> tuple[Choice[TransferFit], Levels]:
    """The same without outliers: bins off the curve are marked as not usable, the light of whole levels as unknown."""
    choice, rule = choose_transfer(levels, dark, full_DN, rules), OutlierRule("bins", rules.outlier_sigma)
    for _ in range(3):
        fit = choice.best.fit
        off = rule.off(np.nan_to_num(fit.variance_z), levels.usable)
        unlike = rule.off(np.nan_to_num(fit.level_z), np.isfinite(fit.level_z))
        if not (off.any() or unlike.any()) or not (levels.usable & ~off).any():
            break
        levels = replace(levels, usable=levels.usable & ~off, light=np.where(unlike, np.nan, levels.light))
        choice = choose_transfer(levels, dark, full_DN, rules)
    return choice, levels
