"""Whether neighbouring pixels share their noise, which photons do not, and whether they see different light.

Where they share noise, the gain is not variance over mean; where they see different light, they have a colour mosaic.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float32

from udccal.fitting.noise.data import Codes

_ROWS = 512


@final
@dataclass(frozen=True)
class Shared:
    """Correlation of a pixel's noise with that of the next of its colour along a row and along a column, and sigma."""

    along_row: float = 0.0
    along_column: float = 0.0
    sigma: float = np.inf

    @property
    def found(self) -> bool:
        """Whether they are no chance."""
        return max(abs(self.along_row), abs(self.along_column)) > 5.0 * self.sigma

    @property
    def gain_factor(self) -> float:
        """The true gain as a multiple of that found: what neighbours share is missing in the variance of each."""
        return max((1 + 2 * self.along_row) * (1 + 2 * self.along_column), 0.0)


def shared_noise(first: Codes, difference: Float32[np.ndarray, "rows columns"], period: int) -> Shared:
    """Of a frame and the next one's difference from it, less the rows' means; colours repeat after ``period`` samples.

    The rows in the middle are enough. Light that differs between the frames leaves a part of the picture, which a
    regression on their sum removes: the noise of sum and difference is independent. Correlation with the third next
    pixel is taken off: noise of columns has it as well.
    """
    rows, far = len(first), 3 * period
    middle = np.s_[max((rows - _ROWS) // 2, 0) : (rows + _ROWS) // 2]
    noise = difference[middle]
    total = cv2.addWeighted(first[middle], 2.0, noise, 1.0, 0.0, dtype=cv2.CV_32F)
    total -= total.mean(axis=1, keepdims=True)
    noise = noise - np.float32(_product(noise, total) / max(_product(total, total), 1e-9)) * total
    near, power = noise[:-far, :-far], max(_product(noise, noise) / noise.size, 1e-9)
    along_row = _product(near, noise[:-far, period : period - far] - noise[:-far, far:])
    along_column = _product(near, noise[period : period - far, :-far] - noise[far:, :-far])
    return Shared(along_row / power / near.size, along_column / power / near.size, float(np.sqrt(2.0 / near.size)))


def pooled(parts: Iterable[Shared]) -> Shared:
    """Their mean by weight."""
    every = np.array([(of.along_row, of.along_column, of.sigma**-2) for of in parts])
    if not len(every):
        return Shared()
    along_row, along_column = (every[:, :2].T @ every[:, 2] / every[:, 2].sum()).tolist()
    return Shared(along_row, along_column, float(every[:, 2].sum() ** -0.5))


def sites_apart(signal_DN: Float32[np.ndarray, "rows columns"]) -> float:
    """How much the light of the brightest site of 2 x 2 exceeds that of the dimmest, relative; 0 where that is chance.

    The rows in the middle are enough. Rows or columns read out with two gains differ by less than a twentieth.
    """
    start = max((len(signal_DN) - _ROWS) // 4, 0) * 2
    sites = [signal_DN[start + row : start + _ROWS : 2, column::2] for row in (0, 1) for column in (0, 1)]
    light, spread = np.array([(float(one.mean()), float(one.std()) / one.size**0.5) for one in sites]).T
    apart = float(np.ptp(light))
    return apart / float(light.mean()) if apart > max(0.05 * abs(light.mean()), 10.0 * spread.max()) else 0.0


def _product(first: Float32[np.ndarray, "rows columns"], second: Float32[np.ndarray, "rows columns"]) -> float:
    """Sum of products; sums by rows keep single precision exact enough."""
    return float(np.einsum("ij,ij->i", first, second).sum(dtype=np.float64))
