"""Averages of a mosaic over square blocks, colour by colour, and their variances."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy import sparse

from udccal.cfa import cfa_named


@final
@dataclass(frozen=True)
class Bins:
    """Averages of a mosaic over blocks of ``step`` x ``step`` pixels (whole cells of the pattern), colour by colour.

    A sample represents the area around it up to half the distance to its neighbours of the same site. Its weight is the
    part of that area inside the block, so that every colour's average belongs to the block's centre.
    """

    cfa: str
    step: int

    def mean(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Return the averages of the samples, in the samples' unit."""
        return self._sum(mosaic, 1, 1)

    def variance(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Return the variances of the averages from those of the samples, where samples are independent."""
        return self._sum(mosaic, 2, 2)

    def row_variance(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Return the same where the noise of a row is common to all its samples."""
        return self._sum(mosaic, 2, 1)

    def _sum(self, mosaic: np.ndarray, row_power: int, column_power: int) -> Float[np.ndarray, "3 a b"]:
        sums = np.zeros((3, *(size // self.step for size in mosaic.shape)))
        pattern = cfa_named(self.cfa)
        # A colour with several samples in a cell averages them.
        factor = 1.0 / np.bincount(pattern.channels.ravel(), minlength=3).clip(1) ** max(row_power, column_power)
        for site in pattern.sites:
            by_row, by_column = (
                _sparse_weights(size, along.start, along.step, self.step) ** power
                for size, along, power in zip(mosaic.shape, site.samples, (row_power, column_power), strict=True)
            )
            part = mosaic[site.samples].astype(np.float64)
            sums[site.channel] += factor[site.channel] * (by_column @ (by_row @ part).T).T
        return sums


# The mosaics of a session have one size.
@functools.lru_cache(maxsize=64)
def _sparse_weights(size: int, first: int, apart: int, step: int) -> sparse.csr_array:
    return sparse.csr_array(block_weights(size, slice(first, None, apart), size // step, step))


def block_weights(size: int, samples: slice, blocks: int, step: int) -> Float[np.ndarray, "blocks samples"]:
    """Return the weights of one site's samples in averages over blocks of ``step`` px, along an axis of ``size`` px.

    A sample covers half the distance to its neighbours of the same site. Where the sensor's edge cuts off a part of a
    block, the block's other samples take over its weight.
    """
    centre = np.arange(size, dtype=np.float64)[samples]
    edge, half = step * np.arange(blocks)[:, None] - 0.5, samples.step / 2
    weights = np.maximum(np.minimum(centre + half, edge + step) - np.maximum(centre - half, edge), 0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
