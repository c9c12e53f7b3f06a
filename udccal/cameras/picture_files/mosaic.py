"""A mosaic that was read from a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import UInt16


@final
@dataclass(frozen=True)
class Mosaic:
    """One raw picture in DN, with the pattern and levels from its file or its user.

    ``exposure_s`` is None where it was not requested or the file does not contain it.
    """

    data: UInt16[np.ndarray, "rows columns"]
    cfa: str
    black_DN: float
    saturation_DN: int
    exposure_s: float | None = None

    @property
    def bits(self) -> int:
        """Bits that hold the saturation level."""
        return min(max(self.saturation_DN.bit_length(), 1), 16)
