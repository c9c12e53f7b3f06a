"""Whether neighbouring pixels share their noise, which photons do not: then the gain is not variance over mean."""

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


def _product(first: Float32[np.ndarray, "rows columns"], second: Float32[np.ndarray, "rows columns"]) -> float:
    """Sum of products; sums by rows keep single precision exact enough."""
    return float(np.einsum("ij,ij->i", first, second).sum(dtype=np.float64))
