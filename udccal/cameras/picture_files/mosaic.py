"""A mosaic out of a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import UInt16


@final
@dataclass(frozen=True)
class Mosaic:
    """One raw picture in DN, with the pattern and levels that its file states or its user did.

    ``exposure_s`` is absent where it was not asked for or the file does not say.
    """

    data: UInt16[np.ndarray, "rows columns"]
    cfa: str
    black_DN: float
    saturation_DN: int
    exposure_s: float | None = None
