"""Which photon transfer model the data ask for, and which of them lie off it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from udccal.fitting.noise.photon_transfer import (
    DarkVariance,
    Levels,
    Order,
    TransferFit,
    fit_transfer,
    responding,
    start_transfer,
)


def choose_transfer(
    levels: Levels, dark: DarkVariance, full_DN: float
) -> tuple[TransferFit, Order, tuple[tuple[Order, float], ...]]:
    """The order with the least BIC, its fit, and the criterion of every order tried (0: the best)."""
    orders = [Order(*(bool(n >> k & 1) for k in range(3))) for n in range(8)]
    if not responding(levels).any():
        orders = [Order(), Order(curved=True)]
    simplest = fit_transfer(levels, dark, full_DN, orders[0], start_transfer(levels, dark))
    start = simplest.values if simplest.converged else start_transfer(levels, dark)
    fits = [simplest, *(fit_transfer(levels, dark, full_DN, order, start) for order in orders[1:])]
    penalty = float(np.log(max(float(levels.dof[levels.usable].sum()), 2.0)))
    criteria = [
        fit.deviance + penalty * order.parameters if np.isfinite(fit.deviance) and fit.converged else np.inf
        for fit, order in zip(fits, orders, strict=True)
    ]
    best = int(np.argmin(criteria))
    least = criteria[best] if np.isfinite(criteria[best]) else 0.0
    tried = tuple((order, value - least) for order, value in zip(orders, criteria, strict=True) if np.isfinite(value))
    return fits[best], orders[best], tried


def without_outliers(levels: Levels, fit: TransferFit, limit: float) -> tuple[Levels, int, tuple[int, ...]]:
    """Levels less what lies beyond ``limit`` robust sigma of the fit; how many bins, and which levels' brightness."""
    z = fit.variance_z[levels.usable]
    scale = max(1.0, 1.4826 * float(np.median(np.abs(z - np.median(z)))))
    wrong = levels.usable & (np.abs(np.nan_to_num(fit.variance_z)) > limit * scale)
    seen = fit.level_z[np.isfinite(fit.level_z)]
    level_scale = max(1.0, 1.4826 * float(np.median(np.abs(seen)))) if seen.size else 1.0
    off = np.abs(np.nan_to_num(fit.level_z)) > limit * level_scale
    cleaned = replace(levels, usable=levels.usable & ~wrong, steady=levels.steady & ~off)
    return cleaned, int(wrong.sum()), tuple(int(i) for i in np.flatnonzero(off))
