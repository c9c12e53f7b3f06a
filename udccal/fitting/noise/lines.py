"""What lines of a sensor, its rows or columns, have in common in frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float


@final
@dataclass(frozen=True)
class Lines:
    """Means of the lines of frames, less those over all frames and over all lines.

    ``variance_DN2`` is one frame's, of which ``sampling_DN2`` is the pixels' own noise. ``power_DN2`` is the square of
    the means' spectrum, summed over frames.
    """

    variance_DN2: float
    sampling_DN2: float
    frames: int
    power_DN2: Float[np.ndarray, " lines"]

    @classmethod
    def of(cls, means_DN: Float[np.ndarray, "frames lines"], sampling_DN2: float) -> Lines:
        """From the means, less those over all frames."""
        frames, lines = means_DN.shape
        left = means_DN - means_DN.mean(axis=1, keepdims=True)
        power = np.sum(np.abs(np.fft.fft(left, axis=1)) ** 2, axis=0)
        return cls(float(np.square(left).sum()) / ((frames - 1) * max(lines - 1, 1)), sampling_DN2, frames, power)
