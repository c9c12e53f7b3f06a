"""Photon transfer and response at once: gain K, read noise V0, curvature by maximum likelihood (EMVA 1288, clause 6).

The sensor turns a linear signal z (DN above black) into y = z - c (z^2 + K z): c is 0 for a linear one. Then

    temporal variance = K z (1 - 2 c z)^2 + V0 + q^2/12,     light part of z = A (u + u0),

with u the relative exposure to light. Sample variances are chi-squared: their weights come from the model, not from the
data. Both relations bear on c; the first alone where the light is unsteady, which is one of the candidates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.iteration_log import LOG

PARAMETERS = ("K_DN_per_e", "V0_DN2", "curvature_per_DN", "response_DN_per_light", "light_offset")
# Bent by more than this share at full scale, the quadratic is no description (and soon has no inverse).
MOST_BENT = 0.24
_ROUNDS = 40


@dataclass(frozen=True)
class Levels:
    """Bright exposures, already reduced: one row per level, one column per bin (CFA site x tile).

    Attributes:
        mean_DN: above black.
        variance_DN2: temporal.
        dof: of the variances.
        samples: per bin and level, frames times pixels: the mean's weight.
        usable: bins safely inside the range of the sensor.
        light: relative exposure; nan where unknown.
        steady: levels whose frames agree in brightness; the others tell nothing about the response.
        dark_DN: dark signal in each level.
        row_variance_DN2: variance of each level's mean from row noise.
    """

    mean_DN: Float[np.ndarray, "levels bins"]
    variance_DN2: Float[np.ndarray, "levels bins"]
    dof: Float[np.ndarray, "levels bins"]
    samples: Float[np.ndarray, "levels bins"]
    usable: Bool[np.ndarray, "levels bins"]
    light: Float[np.ndarray, " levels"]
    steady: Bool[np.ndarray, " levels"]
    dark_DN: Float[np.ndarray, " levels"]
    row_variance_DN2: Float[np.ndarray, " levels"]


@dataclass(frozen=True)
class DarkVariance:
    """What dark frames tell about V0: each estimate (DN^2) with its standard deviation; and the rounding to add.

    The estimates hold for the gain ``K_DN_per_e``; with another one the shot noise of their dark signal ``drift_DN``
    changes, and they by as much.
    """

    V0_DN2: Float[np.ndarray, " points"]
    sigma_DN2: Float[np.ndarray, " points"]
    rounding_DN2: float
    K_DN_per_e: float
    drift_DN: Float[np.ndarray, " points"]

    def expected(self, K_DN_per_e: float, V0_DN2: float) -> Float[np.ndarray, " points"]:
        """What the estimates should come out as."""
        return V0_DN2 + (K_DN_per_e - self.K_DN_per_e) * self.drift_DN


@dataclass(frozen=True)
class Order:
    """Which parts of the model are free: curvature, offset of the exposures, light that differs by level."""

    curved: bool = False
    offset: bool = False
    unsteady: bool = False

    @property
    def name(self) -> str:
        """For the table of candidates."""
        parts = ["curved" if self.curved else "linear"]
        parts += ["exposure offset"] * self.offset + ["unsteady light"] * self.unsteady
        return "response: " + ", ".join(parts)

    @property
    def parameters(self) -> int:
        """Beyond those that every candidate has."""
        return int(self.curved) + int(self.offset) + int(self.unsteady)


@dataclass(frozen=True)
class TransferFit:
    """Values in the order of ``PARAMETERS`` with their covariance, and how well they describe the data.

    ``scatter`` is the relative standard deviation of the light from level to level; ``variance_z`` and ``level_z`` are
    residuals in units of sigma, nan where unused.
    """

    values: Float[np.ndarray, "5"]
    cov: Float[np.ndarray, "5 5"]
    scatter: float
    deviance: float
    chi2_dof: float
    converged: bool
    variance_z: Float[np.ndarray, "levels bins"]
    level_z: Float[np.ndarray, " levels"]


def linear_signal(mean_DN, curvature_per_DN, K_DN_per_e):  # type: ignore[no-untyped-def]
    """z from y = z - c (z^2 + K z); works on numpy and JAX arrays alike."""
    slope = 1 - curvature_per_DN * K_DN_per_e
    # The root that goes to y / slope for c -> 0, in the form without cancellation.
    return 2 * mean_DN / (slope + (slope**2 - 4 * curvature_per_DN * mean_DN) ** 0.5)


def temporal_variance(signal_DN, K_DN_per_e, V0_DN2, curvature_per_DN, rounding_DN2):  # type: ignore[no-untyped-def]
    """Temporal variance in DN^2 at the linear signal z; works on numpy and JAX arrays alike."""
    return K_DN_per_e * signal_DN * (1 - 2 * curvature_per_DN * signal_DN) ** 2 + V0_DN2 + rounding_DN2


def fit_transfer(
    levels: Levels, dark: DarkVariance, full_DN: float, order: Order, start: Float[np.ndarray, "5"]
) -> TransferFit:
    """Fisher scoring on the likelihood of all variances and level means.

    Args:
        levels: bright exposures; at least one usable bin.
        dark: what dark frames tell about V0.
        full_DN: saturation above black; sets the scale of the curvature.
        order: what is free.
        start: values of ``PARAMETERS`` to begin with.
    """
    x, scatter2 = np.array(start, dtype=np.float64), 0.0
    x[2] = x[2] if order.curved else 0.0
    x[4] = x[4] if order.offset else 0.0
    responds = responding(levels)
    free = np.array([True, True, order.curved, responds.any(), order.offset and bool(responds.any())])
    converged = False
    for iteration in range(1, _ROUNDS + 1):
        residual, weight, slope = _linearised(x, levels, dark, full_DN, scatter2)
        information = slope.T @ (slope * weight[:, None])
        information = np.where(np.outer(free, free), information, 0.0)
        step = scaled_inverse(information) @ np.where(free, slope.T @ (weight * residual), 0.0)
        x = _inside(x + step, full_DN)
        if order.unsteady:
            scatter2 = _scatter2(x, levels, responds)
        gain = float(step @ information @ step)
        LOG.debug("noise, photon transfer: iteration %d, moved by %.3g sigma", iteration, max(gain, 0.0) ** 0.5)
        if gain < 1e-8:
            converged = True
            break
    _, _, slope = _linearised(x, levels, dark, full_DN, scatter2)
    return _judged(x, levels, dark, scatter2, scaled_inverse(information), converged)


def responding(levels: Levels) -> Bool[np.ndarray, " levels"]:
    """Levels whose brightness tells about the response."""
    seen = levels.usable.any(axis=1) & levels.steady & np.isfinite(levels.light)
    known = levels.light[seen]
    # Levels of one and the same exposure differ by the lamp's power, which nobody measured.
    return seen if known.size > 2 and float(np.ptp(known)) > 0 else np.zeros_like(seen)


def _inside(x: Float[np.ndarray, "5"], full_DN: float) -> Float[np.ndarray, "5"]:
    x = x.copy()
    x[2] = np.clip(x[2], -MOST_BENT / full_DN, MOST_BENT / full_DN)
    return x


def _parts(
    x: Float[np.ndarray, "5"], levels: Levels, dark: DarkVariance
) -> tuple[Float[np.ndarray, "levels bins"], Float[np.ndarray, "levels bins"], Float[np.ndarray, " levels"]]:
    """Modelled variances, and the levels' brightness over that modelled, less one."""
    K, V0, c, gain, offset = x
    mean = np.where(levels.usable, levels.mean_DN, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        signal = np.nan_to_num(linear_signal(mean, c, K), posinf=0.0)
    variance = np.maximum(temporal_variance(signal, K, V0, c, dark.rounding_DN2), 1e-9)
    brightness = _brightness(signal - levels.dark_DN[:, None], levels.usable)
    expected = gain * (levels.light + offset)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = brightness / expected - 1
    return signal, variance, relative


def _brightness(light_DN: Float[np.ndarray, "levels bins"], usable: np.ndarray) -> Float[np.ndarray, " levels"]:
    """Mean light of each level as if every bin were usable in it: bins share one pattern through all levels."""
    complete = np.flatnonzero(usable.all(axis=1))
    if complete.size == np.count_nonzero(usable.any(axis=1)):
        return light_DN.mean(axis=1)
    # Alternating from the complete levels' pattern, the others add little; from none the first rounds would be rough.
    pattern = light_DN[complete].sum(axis=0) if complete.size else np.ones(usable.shape[1])
    pattern = pattern / max(float(pattern.mean()), 1e-9)
    count = np.maximum(usable.sum(axis=1), 1)
    for _ in range(6):
        level = np.where(usable, light_DN, 0.0).sum(axis=1) / np.maximum((usable * pattern).sum(axis=1), 1e-9)
        weight = (usable * (level**2)[:, None]).sum(axis=0)
        moved = np.where(usable, light_DN * level[:, None], 0.0).sum(axis=0) / np.maximum(weight, 1e-12)
        pattern = np.where(weight > 0, moved, 1.0)
        pattern /= max(float(pattern.mean()), 1e-9)
    return np.where(count > 0, level, 0.0)


def _level_variance(levels: Levels, variance: Float[np.ndarray, "levels bins"]) -> Float[np.ndarray, " levels"]:
    """Relative variance of each level's brightness by shot, read and row noise."""
    count = np.maximum(levels.usable.sum(axis=1), 1)
    mean = np.where(levels.usable, levels.mean_DN, 0.0).sum(axis=1) / count
    noise = np.where(levels.usable, variance / levels.samples, 0.0).sum(axis=1) / count**2
    return (noise + levels.row_variance_DN2) / np.maximum(mean, 1e-9) ** 2


def _linearised(
    x: Float[np.ndarray, "5"], levels: Levels, dark: DarkVariance, full_DN: float, scatter2: float
) -> tuple[Float[np.ndarray, " data"], Float[np.ndarray, " data"], Float[np.ndarray, "data 5"]]:
    responds = responding(levels)

    def predicted(at: Float[np.ndarray, "5"]) -> Float[np.ndarray, " data"]:
        _, variance, relative = _parts(at, levels, dark)
        return np.concatenate([variance[levels.usable], dark.expected(at[0], at[1]), -relative[responds]])

    _, variance, relative = _parts(x, levels, dark)
    off = dark.V0_DN2 - dark.expected(x[0], x[1])
    residual = np.concatenate([(levels.variance_DN2 - variance)[levels.usable], off, relative[responds]])
    weight = np.concatenate(
        [
            1 / _sampling(x, levels, variance)[levels.usable],
            1 / dark.sigma_DN2**2,
            1 / (_level_variance(levels, variance)[responds] + scatter2),
        ]
    )
    # Slopes by central differences, in steps small beside each parameter's own size.
    size = np.array([abs(x[0]), abs(x[1]) + dark.rounding_DN2 + 1e-3, 0.1 / full_DN, abs(x[3]), _light_size(levels)])
    columns = []
    for step in np.diag(1e-4 * size):
        columns.append((predicted(x + step) - predicted(x - step)) / (2 * step.sum()))
    return residual, weight, np.stack(columns, axis=1)


def _light_size(levels: Levels) -> float:
    known = levels.light[np.isfinite(levels.light)]
    return max(float(np.max(known, initial=0.0)), 1e-30)


def _sampling(
    x: Float[np.ndarray, "5"], levels: Levels, variance: Float[np.ndarray, "levels bins"]
) -> Float[np.ndarray, "levels bins"]:
    """Variance of (sample variance - K mean): of Poisson counts the two err together, of read noise apart."""
    return 2 * variance**2 / levels.dof + x[0] ** 2 * (max(x[1], 0.0) + 1e-12) / levels.samples


def _scatter2(x: Float[np.ndarray, "5"], levels: Levels, responds: np.ndarray) -> float:
    """Maximum-likelihood variance of the light from level to level, beyond what noise explains."""
    dark = DarkVariance(np.zeros(0), np.zeros(0), 0.0, 0.0, np.zeros(0))
    _, variance, relative = _parts(x, levels, dark)
    known = _level_variance(levels, variance)[responds]
    square = relative[responds] ** 2
    found = float(np.mean(square))
    for _ in range(50):
        weight = 1 / (found + known) ** 2
        found = max(float(np.sum(weight * (square - known)) / np.sum(weight)), 0.0)
    return found


def _judged(
    x: Float[np.ndarray, "5"],
    levels: Levels,
    dark: DarkVariance,
    scatter2: float,
    cov: Float[np.ndarray, "5 5"],
    converged: bool,
) -> TransferFit:
    _, variance, relative = _parts(x, levels, dark)
    responds, use = responding(levels), levels.usable
    spread = np.sqrt(_sampling(x, levels, variance))
    variance_z = np.where(use, (levels.variance_DN2 - variance) / spread, np.nan)
    level_variance = _level_variance(levels, variance) + scatter2
    level_z = np.where(responds, relative / np.sqrt(np.where(responds, level_variance, 1.0)), np.nan)
    dark_z = (dark.V0_DN2 - dark.expected(x[0], x[1])) / dark.sigma_DN2
    ratio = np.maximum(levels.variance_DN2[use] / variance[use], 1e-12)
    deviance = float(np.sum(levels.dof[use] * (ratio - 1 - np.log(ratio)))) + float(np.sum(dark_z**2))
    deviance += float(np.nansum(level_z**2) + np.sum(np.log(level_variance[responds])))
    chi2 = float(np.nansum(variance_z**2))
    finite = bool(np.isfinite(x).all() and np.isfinite(cov).all())
    chi2_dof = chi2 / max(int(use.sum()) - 1, 1)
    return TransferFit(x, cov, float(np.sqrt(scatter2)), deviance, chi2_dof, converged and finite, variance_z, level_z)


def start_transfer(levels: Levels, dark: DarkVariance) -> Float[np.ndarray, "5"]:
    """A straight line with rough weights, and the response through the origin."""
    use = levels.usable
    signal, variance = levels.mean_DN[use], levels.variance_DN2[use]
    floor = float(np.average(dark.V0_DN2, weights=1 / dark.sigma_DN2**2)) + dark.rounding_DN2
    K = float(np.median((variance - floor) / np.maximum(signal, 1e-9)))
    light = np.where(np.isfinite(levels.light), levels.light, 0.0)
    brightness = _brightness(levels.mean_DN - levels.dark_DN[:, None], use)
    gain = float(light @ brightness) / max(float(light @ light), 1e-30)
    return np.array([K, floor - dark.rounding_DN2, 0.0, gain if gain > 0 else 1.0, 0.0])
