"""What differs from row to row and pixel to pixel: row noise, PRNU, hot pixels (EMVA 1288, clauses 8 and 9; ELD)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16

# Fourth difference over same-colour neighbours: blind to cubics, and to the slow modulation by the panel to
# (2 sin(2 pi / period))^4; its coefficients' squares sum to 70.
_STENCIL = (1.0, -4.0, 6.0, -4.0, 1.0)
_STENCIL_POWER = 70.0
_OUTLIER = 6.0


@dataclass(frozen=True)
class RowMoments:
    """From one pair of dark frames: sigma_row^2 in DN^2 (may be negative by chance) and its standard deviation."""

    variance_DN2: float
    sigma_DN2: float


@dataclass(frozen=True)
class Prnu:
    """PRNU1288 with its sigma, the samples used and the outliers left out."""

    value: float
    sigma: float
    samples: int
    outliers: int


def row_moments(first: UInt16[np.ndarray, "rows columns"], second: UInt16[np.ndarray, "rows columns"]) -> RowMoments:
    """Variance of the row means of the difference, less what independent pixels would give, halved.

    Samples beyond 6 sigma of the difference are left out, so that a blinking pixel is not taken for a row.
    """
    difference = first.astype(np.float64) - second
    difference -= np.median(difference)
    good = np.abs(difference) <= _OUTLIER * max(float(difference.std()), 0.5)
    count = np.maximum(good.sum(axis=1), 1)
    means = np.where(good, difference, 0.0).sum(axis=1) / count
    within = np.where(good, (difference - means[:, None]) ** 2, 0.0).sum(axis=1) / np.maximum(count - 1, 1)
    observed = float(np.var(means, ddof=1))
    expected = float(np.mean(within / count))
    spread = observed * np.sqrt(2.0 / (means.size - 1))
    return RowMoments(0.5 * (observed - expected), 0.5 * spread)


def combine_rows(moments: tuple[RowMoments, ...]) -> tuple[float, float]:
    """sigma_row in DN and its sigma from all pairs; zero when the excess variance is not above zero."""
    variance = float(np.mean([m.variance_DN2 for m in moments]))
    sigma = float(np.sqrt(np.sum([m.sigma_DN2**2 for m in moments]))) / len(moments)
    if variance <= 0:
        return 0.0, float(np.sqrt(sigma))
    value = float(np.sqrt(variance))
    return value, sigma / (2 * value)


def prnu(
    signal_DN: Float[np.ndarray, "rows columns"], temporal_variance_DN2: Float[np.ndarray, "rows columns"]
) -> Prnu:
    """Photo-response non-uniformity of an evenly lit picture behind shading and a slow modulation.

    Smooth structure is removed by a fourth difference among same-colour neighbours along x, and along y; structure
    can only add variance, so the direction with less is used. The temporal variance that averaging left is subtracted.

    Args:
        signal_DN: average of flats minus average of darks.
        temporal_variance_DN2: temporal variance of ``signal_DN`` itself (that is, already divided by frames).
    """
    along = [
        _prnu_along(signal_DN, temporal_variance_DN2),
        _prnu_along(np.ascontiguousarray(signal_DN.T), np.ascontiguousarray(temporal_variance_DN2.T)),
    ]
    return min(along, key=lambda item: item.value)


def _prnu_along(signal: Float[np.ndarray, "rows columns"], temporal: Float[np.ndarray, "rows columns"]) -> Prnu:
    width = signal.shape[1] - 8
    windows = [signal[:, 2 * k : 2 * k + width].astype(np.float64) for k in range(5)]
    level = np.mean(windows, axis=0)
    lit = level > 0
    temporals = [temporal[:, 2 * k : 2 * k + width] for k in range(5)]
    stencil = np.asarray(_STENCIL)
    relative = np.tensordot(stencil, windows, 1)[lit] / level[lit]
    noise = np.tensordot(stencil**2, temporals, 1)[lit] / level[lit] ** 2
    if relative.size < 100:
        return Prnu(0.0, 1.0, int(relative.size), 0)
    spread = 1.4826 * float(np.median(np.abs(relative - np.median(relative))))
    good = np.abs(relative) <= _OUTLIER * max(spread, 1e-12)
    observed = float(np.mean(relative[good] ** 2)) / _STENCIL_POWER
    variance = observed - float(np.mean(noise[good])) / _STENCIL_POWER
    # Neighbouring differences share samples: the sum of squared autocorrelations of the stencil is about 2.6.
    sigma_variance = observed * np.sqrt(2.0 * 2.6 / good.sum())
    value = float(np.sqrt(max(variance, 0.0)))
    return Prnu(value, float(sigma_variance / (2 * max(value, 1e-5))), int(good.sum()), int((~good).sum()))


def count_hot(dark_DN: Float[np.ndarray, "rows columns"]) -> int:
    """Pixels of an averaged dark frame more than 8 robust sigma (and at least 2 DN) above the median."""
    middle = float(np.median(dark_DN))
    spread = 1.4826 * float(np.median(np.abs(dark_DN - middle)))
    return int(np.sum(dark_DN > middle + max(8 * spread, 2.0)))
