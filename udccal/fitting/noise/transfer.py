"""Photon transfer and response at once: gain K, read noise V0, curvature by maximum likelihood (EMVA 1288, clause 6).

The sensor turns a linear signal z (DN above black) into y = z - c (z^2 + K z): c is 0 for a linear one. Then

    temporal variance = K z (1 - 2 c z)^2 + V0 + q^2/12,     light part of z = A (u + u0),

with u the relative exposure to light. Sample variances are chi-squared: their weights come from the model, not from the
data. Both relations determine c; where the light is unsteady, which is one of the orders, only the first does.
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
from udccal.models.noise import linear_signal

Grid = Float[np.ndarray, "levels bins"]
PerLevel = Float[np.ndarray, " levels"]
PerBin = Float[np.ndarray, " usable"]
# K [DN/e], V0 [DN^2], curvature [1/DN], response [DN per light], offset of the light.
Five = Float[np.ndarray, "5"]


@final
@dataclass(frozen=True)
class Levels:
    """Bright exposures, already reduced: one row per level, one column per bin (CFA site x tile).

    ``mean_DN`` is above black, ``variance_DN2`` temporal with ``dof``, ``samples`` are frames times pixels, ``usable``
    are bins safely inside the range of the sensor, and ``light`` is the relative exposure to light, nan where unknown.
    ``dark_DN`` is each level's dark signal, and ``row_variance_DN2`` the variance of its mean by row noise and black.
    """

    mean_DN: Grid
    variance_DN2: Grid
    dof: Grid
    samples: Grid
    usable: Bool[np.ndarray, "levels bins"]
    light: PerLevel
    dark_DN: PerLevel
    row_variance_DN2: PerLevel

    @property
    def responding(self) -> Bool[np.ndarray, " levels"]:
        """Levels whose brightness counts for the response."""
        seen = self.usable.any(axis=1) & np.isfinite(self.light)
        # Levels of one exposure differ by the lamp's power, which was not measured.
        return np.asarray(seen & bool(seen.sum() > 2 and np.ptp(self.light[seen]) > 0))

    @property
    def brightness_variance(self) -> PerLevel:
        """Relative variance of each level's brightness by shot, read and row noise."""
        count = np.maximum(self.usable.sum(axis=1), 1)
        mean = np.where(self.usable, self.mean_DN, 0.0).sum(axis=1) / count
        noise = np.where(self.usable, self.variance_DN2 / self.samples, 0.0).sum(axis=1) / count**2
        return np.asarray((noise + self.row_variance_DN2) / np.maximum(mean, 1e-9) ** 2)


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
    """Which parts of the model are free: curvature, offset of the exposures, light that differs by level."""

    curved: bool = False
    offset: bool = False
    unsteady: bool = False

    @property
    def name(self) -> str:
        """For the table of candidates."""
        offset, unsteady = ", exposure offset" * self.offset, ", unsteady light" * self.unsteady
        return f"response: {'curved' if self.curved else 'linear'}{offset}{unsteady}"


@final
@dataclass(frozen=True)
class TransferFit:
    """One order: values, covariance, relative scatter of the light by level, and residuals in sigma (nan: unused).

    ``misfit`` tells whether the variances scatter by more than noise, ``samples`` how many data there are.
    """

    order: Order
    values: Five
    cov: Float[np.ndarray, "5 5"]
    scatter: float
    converged: bool
    variance_z: Grid
    level_z: PerLevel
    misfit: MisfitTest
    samples: int


def temporal_variance(signal_DN, K_DN_per_e, V0_DN2, curvature_per_DN, rounding_DN2):  # type: ignore[no-untyped-def]
    """K z (1 - 2 c z)^2 + V0 + rounding in DN^2 (EMVA 1288, clause 6), for a linear signal z above black.

    Arguments and result are numpy or JAX arrays; the curvature c is 0 for a linear response, the rounding q^2 / 12.
    """
    return K_DN_per_e * signal_DN * (1 - 2 * curvature_per_DN * signal_DN) ** 2 + V0_DN2 + rounding_DN2


@final
@dataclass(frozen=True)
class TransferProblem:
    """The solver's problem: deviance from the model; the curvature's bound, and scales of the parameters for steps."""

    levels: Levels
    dark: DarkVariance
    order: Order
    bound: float
    sizes: Five
    name: str = "noise, photon transfer"

    @property
    def free(self) -> Bool[np.ndarray, "5"]:
        """Parameters of the order."""
        return np.array([True, True, self.order.curved, True, self.order.offset])

    def predicted(self, x: Five) -> tuple[PerBin, Float[np.ndarray, " points"], PerLevel]:
        """Usable variances and estimates of V0 by the model, and how much less light than it the levels have."""
        K, V0, c, gain, offset = x
        levels, dark = self.levels, self.dark
        with np.errstate(divide="ignore", invalid="ignore"):
            signal = np.nan_to_num(linear_signal(np.where(levels.usable, levels.mean_DN, 0.0), c, K), posinf=0.0)
            variance = np.maximum(temporal_variance(signal[levels.usable], K, V0, c, dark.rounding_DN2), 1e-9)
            bright = _brightness(signal - levels.dark_DN[:, None], levels.usable) / (gain * (levels.light + offset))
        return variance, V0 + (K - dark.K_DN_per_e) * dark.drift_DN, (1 - bright)[levels.responding]

    def spread2(self, lacking: PerLevel) -> tuple[PerLevel, float]:
        """Relative variance of responding levels, and the maximum-likelihood part of it that is no noise."""
        known = self.levels.brightness_variance[self.levels.responding]
        own = excess_variance(lacking**2, known, np.ones(len(known)))[0] if self.order.unsteady else 0.0
        return known + own, own

    def equations_at(self, place: Five) -> Blocks:
        """Score and Fisher information; the scatter of the light is the maximum-likelihood one at this place."""
        levels, dark, (variance, floor, lacking) = self.levels, self.dark, self.predicted(place)
        spread2, _ = self.spread2(lacking)
        observed, dof = levels.variance_DN2[levels.usable], levels.dof[levels.usable]
        off = np.concatenate([observed - variance, dark.V0_DN2 - floor, -lacking])
        weight = np.concatenate([0.5 * dof / variance**2, dark.sigma_DN2**-2, 1 / spread2])
        # Free parameters are those of the order that the data determine.
        free, jacobian = self.free & ((np.arange(5) < 3) | (lacking.size > 0)), np.zeros((len(off), 5))
        for i in np.flatnonzero(free):
            step = 1e-4 * self.sizes[i] * np.eye(5)[i]
            up, down = (np.concatenate(self.predicted(place + sign * step)) for sign in (1, -1))
            jacobian[:, i] = (up - down) / (2 * step[i])
        ratio = np.maximum(observed / variance, 1e-12)
        cost = float(np.sum(dof * (ratio - 1 - np.log(ratio))) + np.sum(np.log(spread2)))
        cost += float(np.sum((weight * off**2)[len(dof) :]))
        score, information = jacobian.T @ (weight * off), jacobian.T @ (weight[:, None] * jacobian)
        held = ~free
        held[2] |= abs(place[2]) >= self.bound and score[2] * place[2] > 0
        return replace(Blocks.dense(cost, len(off), information, score), held=held)

    def moved(self, place: Five, step: Step) -> Five:
        """The place after a step, with the curvature inside its bound."""
        x = place + step.shared
        x[2] = np.clip(x[2], -self.bound, self.bound)
        return x

    def attempt(self, start: Five) -> Attempt[TransferFit]:
        """The fit of the order."""
        order, levels, usable = self.order, self.levels, self.levels.usable
        found = minimise(self, np.where(self.free, start, 0.0))
        cov = found.with_rest(found.equations.cov())
        variance, _, lacking = self.predicted(found.place)
        spread2, own = self.spread2(lacking)
        variance_z, level_z, dof = np.full(usable.shape, np.nan), np.full(len(usable), np.nan), levels.dof[usable]
        variance_z[usable] = (levels.variance_DN2[usable] / variance - 1) * np.sqrt(dof / 2)
        level_z[levels.responding] = np.nan_to_num(-lacking) / np.sqrt(spread2)
        misfit, samples = chi2_test(float(np.nansum(variance_z**2)), max(dof.size - 1.0, 1.0)), int(dof.sum())
        parameters, scatter = order.curved + order.offset + order.unsteady, float(np.sqrt(own))
        criterion = bic(found.equations.cost, float(parameters), samples) if found.converged else np.inf
        residuals = variance_z, level_z
        fit = TransferFit(order, found.place, cov, scatter, found.converged, *residuals, misfit, samples)
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


def _rounding_off(variance_DN2: Grid, rounding_DN2: float) -> Grid:
    """Relative mean square by which variances of rounded codes differ from noise plus q^2/12 (Widrow and Kollar, 2008).

    It is that of the first harmonic, whose phase is the mean's place between two codes: all bins of a level share it.
    """
    noise = np.maximum(variance_DN2 / (12 * rounding_DN2) - 1 / 12, 0.0)
    most = (1 / np.pi**2 + 4 * noise) * np.exp(-2 * np.pi**2 * noise)
    return np.asarray(0.5 * (most * 12 * rounding_DN2 / np.maximum(variance_DN2, 1e-9)) ** 2)


def choose_transfer(levels: Levels, dark: DarkVariance, full_DN: float, rules: NoiseRules) -> Choice[TransferFit]:
    """The order with the least BIC, its fit, and the criterion of every order; at least one bin is usable."""
    # A straight line with rough weights, and the response through the origin.
    use, light = levels.usable, np.nan_to_num(levels.light)
    V0 = float(np.average(dark.V0_DN2, weights=1 / dark.sigma_DN2**2))
    shot = levels.variance_DN2[use] - V0 - dark.rounding_DN2
    K = float(np.median(shot / np.maximum(levels.mean_DN[use], 1e-9)))
    gain = float(light @ _brightness(levels.mean_DN - levels.dark_DN[:, None], use)) / max(float(light @ light), 1e-30)
    start = np.array([K, V0, 0.0, gain if gain > 0 else 1.0, 0.0])
    # A variance and the mean of its bin have correlated errors for Poisson counts, and independent ones for read noise.
    apart = K**2 * max(V0, 0.0) / levels.samples / np.maximum(levels.variance_DN2, 1e-9) ** 2
    apart += _rounding_off(levels.variance_DN2, dark.rounding_DN2) * levels.usable.sum(axis=1, keepdims=True)
    levels = replace(levels, dof=levels.dof / (1 + 0.5 * levels.dof * apart))
    sizes = np.abs(start) + np.array([1e-9, dark.rounding_DN2 + 1e-3, 0.1 / full_DN, 1e-9, max(light.max(), 1e-30)])
    simplest = TransferProblem(levels, dark, Order(), rules.most_bent / full_DN, sizes)
    first = simplest.attempt(start)
    # The other orders start from the simplest one.
    start = first.fit.values if first.fit.converged else start
    others = [Order(curved, offset, unsteady) for unsteady, offset, curved in product((False, True), repeat=3)][1:]
    others = others if levels.responding.any() else [Order(curved=True)]
    return choose([first, *(replace(simplest, order=order).attempt(start) for order in others)])


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
