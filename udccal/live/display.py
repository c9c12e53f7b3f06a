"""From restored linear light to 8-bit pictures, quickly and without flicker."""

from __future__ import annotations

from typing import Final, final

import numpy as np
from jaxtyping import Float32, UInt8

from udccal.restoration.tone import display_exposure, encode_srgb

# Levels of linear light in the table: the darkest differ by a fifth of an 8-bit step after encoding.
_LEVELS: Final = 1 << 14
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
        levels = linear * np.float32(self._exposure * (_LEVELS - 1))
        np.clip(levels, 0.0, _LEVELS - 1.0, out=levels)
        return np.take(_TABLE, levels.astype(np.uint16), mode="clip")
