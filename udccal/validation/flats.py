"""A flat over a wire map: the light of the day in front of the panel, and medians over parts of the sensor."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.wire.data import FlatNoise, Weighed, tile_numbers

# Parts of the sensor, down and across; a part has a median where it has so many pixels.
CELLS, _LEAST = (24, 32), 8
# Sigma of a median over that of a mean, for a normal distribution.
_OF_MEDIAN = 1.2533


def light_design(scaled: Float[np.ndarray, "n 2"], site: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n columns"]:
    """Return the columns of a light that changes slowly: a level per colour site, and a polynomial of second degree.

    Positions are from -1 to 1 over the sensor.
    """
    x, y = scaled.T
    sites = np.eye(int(site.max()) + 1)[site]
    return np.column_stack([sites, x, y, x * x, x * y, y * y])


NO_PARTS = (
    "No part of the sensor has enough pixels that can be compared: the sensor is very small, or nearly all pixels of "
    "the flat are far off. Calibrate the rig again."
)


def cell_medians(
    seen: Weighed, noise: FlatNoise
) -> tuple[Float[np.ndarray, "down across"], Float[np.ndarray, "down across"]]:
    """Return the median of the flat over the map, less 1, by part of the sensor, and its sigma; NaN without pixels.

    Pixels that are far off count here, as a smudge has many. Single defects do not move a median.
    """
    pixels = seen.pixels
    here = (pixels.weight > 0) | seen.outlying
    expected = seen.expected[here]
    variance = noise.variance(pixels.site[here], expected) / expected**2
    return part_medians(pixels.value[here] / expected - 1, variance, pixels.scaled[here])


def part_medians(
    values: Float[np.ndarray, " n"], variance: Float[np.ndarray, " n"], scaled: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "down across"], Float[np.ndarray, "down across"]]:
    """Return medians of values at positions from -1 to 1 by part of the sensor, and their sigma; NaN without pixels."""
    cell = tile_numbers(scaled, CELLS)
    order, ends = np.argsort(cell, kind="stable"), np.cumsum(np.bincount(cell, minlength=CELLS[0] * CELLS[1]))[:-1]
    found = [
        (float(np.median(one)), float(_OF_MEDIAN / np.sqrt(np.sum(1 / noisy)))) if len(one) >= _LEAST else (np.nan,) * 2
        for one, noisy in zip(*(np.split(of[order], ends) for of in (values, variance)), strict=True)
    ]
    middle, sigma = np.array(found).T.reshape(2, *CELLS)
    return middle, sigma
