"""Averages of a mosaic over square blocks, colour by colour, and their variances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy import sparse

from udccal.cfa import cell_channels


@final
@dataclass(frozen=True)
class Bins:
    """Averages of a mosaic over blocks of ``step`` x ``step`` (even) pixels, colour by colour.

    A sample of a colour represents the 2 x 2 pixels around it and counts by the part of them inside the block: then
    every colour's average is of the block's centre, though its samples are not.
    """

    cfa: str
    step: int

    def mean(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Averages of the samples."""
        return self._sum(mosaic, 1, 1)

    def variance(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Variances of the averages from those of the samples, each by itself."""
        return self._sum(mosaic, 2, 2)

    def row_variance(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """The same where the samples of a row go up and down together."""
        return self._sum(mosaic, 2, 1)

    def _sum(self, mosaic: np.ndarray, row_power: int, column_power: int) -> Float[np.ndarray, "3 a b"]:
        sums = np.zeros((3, *(size // self.step for size in mosaic.shape)))
        cells = np.asarray(cell_channels(self.cfa))
        # A colour with two samples in a cell averages them.
        factor = 1.0 / np.bincount(cells.ravel(), minlength=3) ** max(row_power, column_power)
        for (j, i), channel in np.ndenumerate(cells):
            part = mosaic[j::2, i::2].astype(np.float64)
            by_row, by_column = (
                sparse.csr_array(block_weights(samples, blocks, self.step, first) ** power)
                for samples, blocks, first, power in zip(
                    part.shape, sums.shape[1:], (j, i), (row_power, column_power), strict=True
                )
            )
            sums[channel] += factor[channel] * (by_column @ (by_row @ part).T).T
        return sums


def block_weights(samples: int, blocks: int, step: int, first: int) -> Float[np.ndarray, "blocks samples"]:
    """Weights of the samples at ``first``, ``first`` + 2, ... px in the averages over blocks of ``step`` px.

    A sample covers one pixel to either side of it; what the sensor's edge cuts off, the others of the block take over.
    """
    centre = first + 2.0 * np.arange(samples)
    edge = step * np.arange(blocks)[:, None] - 0.5
    weights = np.maximum(np.minimum(centre + 1, edge + step) - np.maximum(centre - 1, edge), 0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
