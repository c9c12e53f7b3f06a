"""What each pixel of an averaged flat is worth: shot and read noise by its expected signal, PRNU, clipping, outliers.

Weights come from the model's signal, not from the sample's own: a pixel that happens to be high would otherwise count
for more (or less) than its neighbours, and the map would be biased.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from udccal.fitting.wire.basis import SITES, Pixels, residuals_and_base
from udccal.models.wire import Wire
from udccal.result import Outliers

_LEAST_PRNU = 1e-5
_OUTLIER = 6.0
_BINS = 32
# A sample variance beyond so many medians of its bin is a pixel that blinks, not noise.
_BLINKING = 30.0
# Weights go by signals of at least this part of the mean.
_LEAST_SIGNAL = 0.01
_PLACES = 20


@final
@dataclass(frozen=True)
class FlatNoise:
    """Variance of an averaged flat whose CFA sites have been divided by their means.

    At a relative signal s of a site: ``floor + by_signal s + (prnu s)^2``. From the site's relative signal ``clip`` on,
    single frames clip: such pixels are left out by what the model says of them.
    """

    floor: Float[np.ndarray, "4"]
    by_signal: Float[np.ndarray, "4"]
    prnu: float
    clip: Float[np.ndarray, "4"]

    def variance(self, site: np.ndarray, signal: np.ndarray) -> np.ndarray:
        """Of pixels of these sites at these relative signals."""
        some = np.maximum(signal, _LEAST_SIGNAL)
        return np.asarray(self.floor[site] + self.by_signal[site] * some + (max(self.prnu, _LEAST_PRNU) * some) ** 2)


def site_numbers(rows: int, columns: int) -> np.ndarray:
    """0 to 3: the place of each pixel in its 2 x 2 CFA cell."""
    y, x = np.ogrid[:rows, :columns]
    return np.asarray(2 * (y % 2) + x % 2)


def flat_noise(
    values: Float[np.ndarray, "rows columns"],
    variance: Float[np.ndarray, "rows columns"],
    means: Float[np.ndarray, "4"],
    prnu: float,
    clip: float,
) -> FlatNoise:
    """Draw a straight line through variance against signal, site by site (EMVA 1288's photon transfer).

    The variance of few frames is itself too noisy to weigh single pixels with.

    Args:
        values: signal over its site's mean.
        variance: of the unbalanced signal, PRNU not included.
        means: the sites' mean signals.
        prnu: relative response from pixel to pixel.
        clip: unbalanced signal from which on single frames clip.
    """
    lines = np.array(
        [
            _line(values[k // 2 :: 2, k % 2 :: 2].ravel(), variance[k // 2 :: 2, k % 2 :: 2].ravel() / means[k] ** 2)
            for k in range(SITES)
        ]
    )
    return FlatNoise(lines[:, 0], lines[:, 1], prnu, clip / means)


def _line(signal: Float[np.ndarray, " n"], variance: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2"]:
    """Constant and slope, neither negative, through the means of bins of equal counts."""
    good = np.isfinite(variance) & np.isfinite(signal) & (variance >= 0)
    if not good.any():
        return np.zeros(2)
    order = np.argsort(signal[good], kind="stable")
    x, y = signal[good][order], variance[good][order]
    bins = []
    for part_x, part_y in zip(np.array_split(x, _BINS), np.array_split(y, _BINS), strict=True):
        kept = part_y <= _BLINKING * np.median(part_y) if len(part_y) else np.zeros(0, dtype=bool)
        if kept.any():
            bins.append((float(np.maximum(part_x[kept].mean(), 0.0)), float(part_y[kept].mean())))
    at, mean = np.array(bins).T
    # Sample variances scatter in proportion to themselves.
    weight = 1.0 / np.maximum(mean, 1e-3 * mean.max() + 1e-300)
    line, _ = nnls(np.stack([weight, at * weight], axis=1), mean * weight)
    return np.asarray(line, dtype=np.float64)


@final
@dataclass(frozen=True)
class Judged:
    """A sample weighed by a model, with what was left out: by the model's clipping, and as outliers.

    ``expected`` is the model's signal in CFA-balanced units.
    """

    pixels: Pixels
    expected: Float[np.ndarray, " n"]
    clipped: int
    outlying: Bool[np.ndarray, " n"]


def judge(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels, noise: FlatNoise) -> Judged:
    """Weigh a sample by the signal that the model expects; leave out what clips and what is 6 robust sigma off.

    Pixels that never had a weight stay without; outliers of an earlier model are looked at anew.
    """
    residual, base = residuals_and_base(wire, gains, pixels)
    expected = pixels.value - residual * base
    variance = noise.variance(pixels.site, expected)
    real = (pixels.place >= 0) & np.isfinite(pixels.value)
    unclipped = expected + 3 * np.sqrt(variance) < noise.clip[pixels.site]
    off = np.abs(pixels.value - expected) / np.sqrt(variance)
    usable = real & unclipped
    spread = 1.4826 * float(np.median(off[usable])) if usable.any() else 1.0
    outlying = usable & ~(off <= _OUTLIER * spread)
    weight = np.where(usable & ~outlying, 1.0 / variance, 0.0)
    kept = eqx.tree_at(lambda p: p.weight, pixels, weight)
    return Judged(kept, expected, int(np.count_nonzero(real & ~unclipped)), outlying)


def listed(judged: Judged, columns: int) -> tuple[Outliers, ...]:
    """What was left out, for a person to look at."""
    found: list[Outliers] = []
    if judged.outlying.any():
        y, x = np.divmod(np.sort(judged.pixels.place[judged.outlying])[:_PLACES], columns)
        places = tuple(f"({row}, {column})" for row, column in zip(y, x, strict=True))
        rule = f"further than {_OUTLIER:g} robust sigma from the fitted map; places are (row, column)"
        found.append(Outliers(rule, int(np.count_nonzero(judged.outlying)), places))
    if judged.clipped:
        found.append(Outliers("so bright, by the fitted map, that single frames clip", judged.clipped))
    return tuple(found)
