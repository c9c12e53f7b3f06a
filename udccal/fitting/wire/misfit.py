"""What the wire's model does not describe: found in what is left over a period of the rows, tile by tile.

Noise is not patterned; a misfit is, over the rows' and the columns' period and from tile to tile. Means over bins of
these show it, however small beside the noise of one pixel, and a chi-squared test says whether it is there. Pixels
that the fit has not seen ("held out") show its statistical errors as well; those are known and are taken off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.engine.tails import chi2_tail
from udccal.fitting.wire.basis import TILES, Pixels, tile_numbers
from udccal.fitting.wire.joint import Joint
from udccal.fitting.wire.noise import Judged
from udccal.models.wire import slopes

# Bins in a tile, down and across: of a period of the rows and of the columns, once finer in one, once in the other.
_BINNINGS = ((12, 3), (3, 12))
# A pattern that noise makes less often than this is the model's.
SIGNIFICANT = 0.01
_LEAST_IN_BIN = 4


@final
@dataclass(frozen=True)
class Misfit:
    """How far the model may be off the truth.

    Attributes:
        sigma: of the map, relative, RMS over the sensor: of patterned residuals (0 where there is no pattern) and
            of what is omitted.
        by_tile: the same, tile by tile; nowhere less than its RMS.
        resolution: the smallest such sigma that would have been seen.
        p_value: of noise alone to leave such patterns.
        bins: that were compared.
        residual_rms: relative, of single pixels.
        omitted: of the harmonics left out, or of rows that may be there unseen; relative, RMS over the sensor.
    """

    sigma: float
    by_tile: Float[np.ndarray, "tiles_y tiles_x"]
    resolution: float
    p_value: float
    bins: int
    residual_rms: float
    omitted: float = 0.0

    @property
    def found(self) -> bool:
        """Whether the residuals are patterned."""
        return self.p_value < SIGNIFICANT


_slopes = jax.jit(slopes)


def misfit(joint: Joint, judged: Judged, statistical: float, held_out: bool) -> Misfit:
    """Test what is left for patterns.

    Args:
        joint: the fit.
        judged: pixels, weighed by the fitted wire and freed of outliers.
        statistical: the fit's own relative sigma, RMS over the map.
        held_out: whether the fit has not seen these pixels.
    """
    pixels, expected = judged.pixels, judged.expected
    used = (pixels.weight > 0) & (expected > 0)
    # Relative to what the model says.
    relative = np.where(used, pixels.value / np.where(used, expected, 1.0) - 1, 0.0)
    weight = np.where(used, pixels.weight * expected**2, 0.0)
    seen = _Seen(relative, weight, used, tile_numbers(pixels), statistical, held_out)
    tests = [_test(seen, _bins(joint, pixels, *binning), int(np.prod(binning))) for binning in _BINNINGS]
    # The sharper of the two counts; that it was chosen from two is paid for.
    best = min(tests, key=lambda t: t.p_value)
    rms = float(np.sqrt(np.mean(relative[used] ** 2))) if used.any() else 0.0
    return replace(best, residual_rms=rms)


@final
@dataclass(frozen=True)
class _Seen:
    """Relative residuals with their weights, and where they are."""

    relative: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    used: Bool[np.ndarray, " n"]
    tile: Int[np.ndarray, " n"]
    statistical: float
    held_out: bool


def _test(seen: _Seen, inside: Int[np.ndarray, " n"], per_tile: int) -> Misfit:
    """Means over bins against their noise; ``inside`` numbers a tile's bins."""
    tiles = TILES[0] * TILES[1]
    bins, size = seen.tile * per_tile + inside, tiles * per_tile
    count = np.bincount(bins, seen.used, minlength=size)
    total = np.bincount(bins, seen.weight, minlength=size)
    mean = np.bincount(bins, seen.weight * seen.relative, minlength=size) / np.maximum(total, 1e-300)
    full = count >= _LEAST_IN_BIN
    free = max(seen.used.sum() - np.count_nonzero(count), 1)
    within = float(np.sum(seen.weight * (seen.relative - mean[bins]) ** 2)) / free
    precision = np.where(full, total / max(within, 1e-300), 0.0)
    compared = float(full.sum())
    fit = seen.statistical**2 if seen.held_out else -(seen.statistical**2)
    if seen.held_out:
        statistic = float(np.sum(mean[full] ** 2 / (1 / precision[full] + fit)))
        p_value = chi2_tail(statistic, compared)
    else:
        degrees = max(compared + fit * float(precision.sum()), 1.0)
        p_value = chi2_tail(np.sum(mean**2 * precision), degrees)
    p_value = min(1.0, len(_BINNINGS) * p_value)
    left = np.where(full, mean**2 * precision - 1 - fit * precision, 0.0).reshape(tiles, per_tile).sum(axis=1)
    weights = precision.reshape(tiles, per_tile).sum(axis=1)
    whole, error = max(float(weights.sum()), 1e-300), np.sqrt(2 * compared)
    sigma = float(np.sqrt(max(left.sum() + error, 0.0) / whole)) if p_value < SIGNIFICANT else 0.0
    local = np.sqrt(np.maximum(left, 0.0) / np.maximum(weights, whole / tiles / 10)) if sigma else np.zeros(tiles)
    by_tile = np.maximum(local, sigma).reshape(TILES)
    return Misfit(sigma, by_tile, float(np.sqrt(error / whole)), p_value, int(compared), 0.0)


def _bins(joint: Joint, pixels: Pixels, down: int, across: int) -> Int[np.ndarray, " n"]:
    """A bin in each pixel's tile: where its ray meets the period of rows and columns; without a panel, by place."""
    if joint.shape:
        wire = joint.wire
        periods = np.asarray(wire.offset)[:, None] + float(wire.standoff_per_pitch) * np.asarray(
            _slopes(wire, pixels.ideal)
        )
    else:
        periods = 0.5 * (pixels.scaled.T + 1) * np.array([[TILES[1]], [TILES[0]]])
    phase = periods - np.floor(periods)
    x, y = (np.minimum((p * n).astype(np.int64), n - 1) for p, n in zip(phase, (across, down), strict=True))
    return np.asarray(y * across + x)


def robust_ratio(joint: Joint) -> Float[np.ndarray, " n"]:
    """Of each parameter, how much larger its sigma is when tiles of the sensor may differ by more than their noise.

    The sandwich estimate (Huber, Proc. 5th Berkeley Symposium, 1967) with the tiles' scores, over the fit's own.
    """
    scores = joint.by_tile / joint.variance
    scores = scores - scores.mean(axis=0)
    tiles = TILES[0] * TILES[1]
    spread = scores.T @ scores * tiles / (tiles - 1) + np.diag(joint.precision)
    sandwich = np.einsum("ij,jk,ki->i", joint.cov, spread, joint.cov)
    return np.sqrt(np.maximum(sandwich / np.diag(joint.cov), 1.0))
