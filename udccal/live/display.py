"""From restored linear light to 8-bit pictures, quickly and without flicker."""

from __future__ import annotations

from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from udccal.restoration.tone import display_exposure, encode_srgb

# Every 16-bit level of linear light has its place in the table.
_LEVELS: Final = 1 << 16
_TABLE: Final = np.rint(255.0 * encode_srgb(np.linspace(0.0, 1.0, _LEVELS))).astype(np.uint8)
# Every so many pixels are looked at to choose the exposure.
_STEP: Final = 8
# Part of the way to the wanted exposure that one frame goes, in logarithms: a third of a second at 30 Hz.
_PART: Final = 0.1


@final
class Display:
    """Encodes pictures for a display; its exposure follows the light slowly."""

    def __init__(self) -> None:
        self._exposure: float | None = None

    def encode(self, linear: Float32[np.ndarray, "rows columns 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
        """Return sRGB of a picture in e-/s."""
        wanted = display_exposure(linear[::_STEP, ::_STEP])
        before = wanted if self._exposure is None else self._exposure
        self._exposure = before * (wanted / before) ** _PART
        scale = self._exposure * (_LEVELS - 1)
        levels = cv2.multiply(
            linear, (scale, scale, scale, scale), dtype=cv2.CV_16U
        )  # rounded, and clipped at the ends
        return cv2.LUT(levels, _TABLE)
