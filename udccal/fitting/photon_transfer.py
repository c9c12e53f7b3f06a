"""Photon transfer: temporal variance against mean, per CFA site and tile, from pairs of flats (EMVA 1288, clause 6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16

# Tiles keep shading and the slow flicker of a lamp out of the variance; each must still hold many samples.
_MOST_TILES = 8
_FEWEST_SAMPLES = 400
# EMVA 1288 fits the photon transfer curve up to 70 % of saturation.
FIT_UP_TO = 0.7
# A bin whose variance has fallen below this fraction of the straight line is saturated.
_COLLAPSED = 0.3


@dataclass(frozen=True)
class PairBins:
    """One pair of frames reduced to bins (CFA site x tile): mean, temporal variance in DN^2, top code, samples."""

    exposure_s: float
    mean_DN: Float[np.ndarray, " bins"]
    variance_DN2: Float[np.ndarray, " bins"]
    median_DN: Float[np.ndarray, " bins"]
    samples: int


@dataclass(frozen=True)
class TransferFit:
    """The straight line variance = K (mean - black) + V0 with the covariance of (K, V0)."""

    K_DN_per_e: float
    V0_DN2: float
    cov: Float[np.ndarray, "2 2"]
    chi2_dof: float
    bins: int
    levels: int


def bin_pair(
    first: UInt16[np.ndarray, "rows columns"], second: UInt16[np.ndarray, "rows columns"], exposure_s: float
) -> PairBins:
    """Reduce a pair of frames of the same scene; a common change of brightness within a tile drops out."""
    total, half_difference, values = [], [], []
    for row in (0, 1):
        for column in (0, 1):
            a = _tiles(first[row::2, column::2])
            b = _tiles(second[row::2, column::2])
            total.append(0.5 * (a.mean(axis=1) + b.mean(axis=1)))
            half_difference.append(0.5 * np.var(a - b, axis=1, ddof=1))
            values.append(np.median(a, axis=1))
            samples = a.shape[1]
    return PairBins(
        exposure_s=exposure_s,
        mean_DN=np.concatenate(total),
        variance_DN2=np.concatenate(half_difference),
        median_DN=np.concatenate(values),
        samples=samples,
    )


def _tiles(site: UInt16[np.ndarray, "rows columns"]) -> Float[np.ndarray, "tiles samples"]:
    across = int(np.clip(np.sqrt(site.size / _FEWEST_SAMPLES), 1, _MOST_TILES))
    height, width = site.shape[0] // across, site.shape[1] // across
    cut = site[: height * across, : width * across].astype(np.float64)
    return cut.reshape(across, height, across, width).transpose(0, 2, 1, 3).reshape(across * across, height * width)


def fit_transfer(
    flats: tuple[PairBins, ...], black_DN: float, saturation_DN: float, dark_variance: tuple[float, float]
) -> TransferFit | None:
    """Fit the line to bins darker than 70 % of saturation; weights come from the fitted line, iterated.

    Args:
        flats: the binned pairs.
        black_DN: mean dark level without dark current (dark current only moves a bin along the line).
        saturation_DN: where the signal stops.
        dark_variance: (temporal dark variance in DN^2 with quantisation, its sigma): one more point, at black.

    Returns:
        The line, or None when fewer than three bins lie inside the range.
    """
    limit = black_DN + FIT_UP_TO * (saturation_DN - black_DN)
    inside = [flat.mean_DN <= limit for flat in flats]
    x = np.concatenate([flat.mean_DN[keep] for flat, keep in zip(flats, inside, strict=True)]) - black_DN
    y = np.concatenate([flat.variance_DN2[keep] for flat, keep in zip(flats, inside, strict=True)])
    n = np.concatenate([np.full(keep.sum(), flat.samples) for flat, keep in zip(flats, inside, strict=True)])
    if x.size < 3:
        return None
    design = np.column_stack([np.append(x, 0.0), np.ones(x.size + 1)])
    data = np.append(y, dark_variance[0])
    model = np.maximum(data, dark_variance[0])
    for _ in range(4):
        # Var(s^2) = 2 sigma^4 / (n - 1) for near-normal samples.
        sigma = np.append(model[:-1] * np.sqrt(2.0 / (n - 1)), dark_variance[1])
        weighted = design / sigma[:, None]
        cov = np.linalg.pinv(weighted.T @ weighted, hermitian=True)
        line = cov @ (weighted.T @ (data / sigma))
        model = np.maximum(design @ line, 0.25 * dark_variance[0])
    chi2 = float(np.sum(((data - design @ line) / sigma) ** 2))
    return TransferFit(
        K_DN_per_e=float(line[0]),
        V0_DN2=float(line[1]),
        cov=cov,
        chi2_dof=chi2 / max(x.size - 1, 1),
        bins=int(x.size),
        levels=sum(bool(keep.any()) for keep in inside),
    )


def find_saturation(flats: tuple[PairBins, ...], black_DN: float, top_code_DN: float) -> tuple[float, float, int]:
    """Level at which the temporal variance collapses: (saturation, its sigma, number of saturated bins).

    A bin is saturated when its variance is under 30 % of what the least saturated half of the data predicts for its
    mean. Where no bin is saturated the converter's largest code is returned, with zero bins.
    """
    mean = np.concatenate([flat.mean_DN for flat in flats]) - black_DN
    variance = np.concatenate([flat.variance_DN2 for flat in flats])
    median = np.concatenate([flat.median_DN for flat in flats])
    bright = mean > 0.05 * (top_code_DN - black_DN)
    if not bright.any():
        return top_code_DN, 0.0, 0
    slope = variance[bright] / mean[bright]
    # Below saturation variance/mean is K plus a small positive part; clipping only lowers it.
    usual = float(np.quantile(slope, 0.75))
    collapsed = slope < _COLLAPSED * usual
    # Saturation is a ceiling: a quiet bin well below the brightest one is something else.
    collapsed &= mean[bright] >= 0.9 * mean[bright].max()
    count = int(collapsed.sum())
    if count == 0:
        return top_code_DN, 0.0, 0
    levels = median[bright][collapsed]
    spread = float(np.std(levels)) if count > 1 else 0.5
    return float(np.median(levels)), max(spread, 0.5) / np.sqrt(count), count
