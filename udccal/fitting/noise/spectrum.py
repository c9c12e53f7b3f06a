"""Which part of a picture's spectrum holds nothing but pixels: white noise, and no light that varies over the sensor.

Light that passed a panel is modulated, and the modulation's harmonics and their products sink slowly below the floor
that the pixels' own response makes. What sinks below the floor is not seen in one coefficient, nor in a block of them,
but the power of many blocks together still shows it: rectangles of all sizes are tested. Beyond what was seen the
light goes on, unseen; so the spectrum is cut as far out again.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.special import ndtri

# Coefficients per side of a block; sides of the tested rectangles, in blocks; and what is more than chance, in sigma.
_BLOCK, _SIDES, _SEEN = 16, (1, 4, 16), 5.0
# Light is expected up to this many times the frequencies at which it was seen,
_REACH = 2.0
# unless that would leave less than this share of the spectrum: then what was seen alone is left out.
_LEAST_LEFT = 0.1
_ROUNDS = 8
# Where the light has less than three quarters of the blocks, this quantile of them is of the floor.
_QUANTILE = 0.25


def white_coefficients(
    powers: list[Float32[np.ndarray, "rows columns"]], taken: tuple[int, int]
) -> Bool[np.ndarray, "rows columns"]:
    """Coefficients of cosine transforms that hold white noise alone; all transforms are of the same light.

    The first line and column hold what differs by rows and by columns: they are never among them.

    Args:
        powers: squared coefficients, one picture per colour site.
        taken: so many of the lowest rows and columns were changed by taking off shading.
    """
    rows, columns = powers[0].shape
    keep = np.ones((rows, columns), bool)
    keep[0], keep[:, 0] = False, False
    keep[: taken[0], : taken[1]] = False
    block = min(_BLOCK, rows // 4, columns // 4)
    if block < 2:
        return keep
    count = _by_block(keep, block)
    pooled = np.zeros(count.shape)
    for power in powers:
        total = _by_block(power * keep, block)
        pooled += total / max(_floor(count, total), 1e-300)
    seen = _light(count * len(powers), pooled)
    wide = _reached(seen)
    left_out = wide if count[~wide].sum() >= _LEAST_LEFT * keep.size else seen
    white = np.zeros_like(keep)
    blocks = np.repeat(np.repeat(~left_out, block, axis=0), block, axis=1)
    white[: blocks.shape[0], : blocks.shape[1]] = blocks
    return white & keep


def _by_block(values: np.ndarray, block: int) -> Float[np.ndarray, "down across"]:
    """Sums over blocks; coefficients that fill no block are left out."""
    high, wide = (n // block * block for n in values.shape)
    # Rows first: sums along contiguous memory are the slow part.
    by_row = np.add.reduce(values[:high, :wide].reshape(high, wide // block, block), axis=2, dtype=np.float32)
    return by_row.reshape(high // block, block, wide // block).sum(axis=1, dtype=np.float64)


def _floor(count: Float[np.ndarray, "down across"], total: Float[np.ndarray, "down across"]) -> float:
    """Power of the floor from a low quantile of the blocks, put right for its being low."""
    full = count >= count.max()
    low = float(np.quantile(total[full] / count[full], _QUANTILE))
    spread = _spread(float(count.max()))
    return low / (1 - spread + float(ndtri(_QUANTILE)) * np.sqrt(spread)) ** 3


def _spread(count: Any) -> Any:
    """The cube root of a mean of so many squared normals is normal: variance s and mean 1 - s (Wilson and Hilferty)."""
    return 2 / (9 * count)


def _light(
    count: Float[np.ndarray, "down across"], total: Float[np.ndarray, "down across"]
) -> Bool[np.ndarray, "down across"]:
    """Blocks with more power than the floor, alone or as part of a rectangle; small rectangles are tested first.

    Args:
        count: coefficients per block, those of all sites together.
        total: their power over the floor's.
    """
    light = np.zeros(count.shape, bool)
    sides = [(down, across) for down in _SIDES for across in _SIDES if down <= len(count) and across <= count.shape[1]]
    sides.sort(key=lambda side: side[0] * side[1])
    floor = _floor(count, total)
    for _ in range(_ROUNDS):
        before = light.copy()
        tables = _summed(np.where(light, 0.0, count)), _summed(np.where(light, 0.0, total))
        for side in sides:
            found = _above(*tables, floor, side) & (count > 0) & ~light
            if found.any():
                light |= found
                tables = _summed(np.where(light, 0.0, count)), _summed(np.where(light, 0.0, total))
        floor = float(tables[1][-1, -1] / max(tables[0][-1, -1], 1.0))
        if np.array_equal(before, light):
            break
    return light


def _above(
    counts: Float[np.ndarray, "down_1 across_1"],
    totals: Float[np.ndarray, "down_1 across_1"],
    floor: float,
    side: tuple[int, int],
) -> Bool[np.ndarray, "down across"]:
    """Blocks of the rectangles of this size, half of it apart, that have too much power, from summed tables."""
    down, across = counts.shape[0] - 1, counts.shape[1] - 1
    (top, bottom), (left, right) = _places(down, side[0]), _places(across, side[1])
    number, power = (_sums(table, top, bottom, left, right) for table in (counts, totals))
    spread = _spread(np.maximum(number, 1))
    seen = np.cbrt(power / np.maximum(number, 1) / max(floor, 1e-300)) > 1 - spread + _SEEN * np.sqrt(spread)
    rows, columns = np.nonzero(seen)
    marks = np.zeros(counts.shape, np.int64)
    for y, x, sign in ((top, left, 1), (bottom, right, 1), (top, right, -1), (bottom, left, -1)):
        np.add.at(marks, (y[rows], x[columns]), sign)
    found: Bool[np.ndarray, "down across"] = marks.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0
    return found


def _places(length: int, side: int) -> tuple[Int[np.ndarray, " places"], Int[np.ndarray, " places"]]:
    """Where rectangles begin and end; those that reach over the end are cut there."""
    starts = np.arange(0, length, max(side // 2, 1))
    return starts, np.minimum(starts + side, length)


def _summed(values: Float[np.ndarray, "down across"]) -> Float[np.ndarray, "down_1 across_1"]:
    """Summed-area table: sums over all that lies above and to the left."""
    table = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    table[1:, 1:] = values.cumsum(axis=0).cumsum(axis=1)
    return table


def _sums(
    table: Float[np.ndarray, "down_1 across_1"],
    top: Int[np.ndarray, " places_y"],
    bottom: Int[np.ndarray, " places_y"],
    left: Int[np.ndarray, " places_x"],
    right: Int[np.ndarray, " places_x"],
) -> Float[np.ndarray, "places_y places_x"]:
    upper, lower = table[top], table[bottom]
    return np.maximum(lower[:, right] - upper[:, right] - lower[:, left] + upper[:, left], 0.0)


def _reached(seen: Bool[np.ndarray, "down across"]) -> Bool[np.ndarray, "down across"]:
    """All blocks at lower frequencies than some multiple of those seen."""
    reached = np.zeros_like(seen)
    for row in range(len(seen)):
        columns = np.flatnonzero(seen[row])
        if columns.size:
            reached[: int(np.ceil(_REACH * (row + 1))), : int(np.ceil(_REACH * (columns[-1] + 1)))] = True
    return reached
