"""Exposure of the shown pictures: it follows the light without flicker, by what was shown last."""

from __future__ import annotations

from typing import Final, final

import numpy as np
from jaxtyping import Float, Float32, UInt8

from udccal.restoration.tone import LEVEL, PERCENTILE, Tone, display_exposure

# Every so many pixels are looked at.
_STEP: Final = 8
_WHITE = 255
# Part of the way to the wanted exposure that one frame goes, in logarithms: a third of a second at 30 Hz.
_PART: Final = 0.1


@final
class AutoExposure:
    """The exposure at which the next picture is shown.

    Args:
        linear: a first picture in e-/s.
        least: light in e-/s that counts as bright where all is darker.
        clips: light in e-/s from which on all is white.
    """

    def __init__(self, linear: Float32[np.ndarray, "rows columns 3"], least: float, clips: float) -> None:
        self.tone = Tone(display_exposure(linear[::_STEP, ::_STEP], least, clips))

    def follow(self, shown: UInt8[np.ndarray, "rows columns 3"], clips: float) -> bool:
        """Move towards the exposure at which ``shown`` would be as bright as a still picture.

        A black picture says nothing. A white one says only that the exposure is far too long, unless it is the shortest
        at which light that clips is white.

        Args:
            shown: the picture at this exposure.
            clips: light in e-/s from which on all is white.

        Returns:
            whether it can be followed: after a white picture, the next one has to begin anew.
        """
        codes = shown[::_STEP, ::_STEP]
        level = float(np.percentile(codes, PERCENTILE))
        if level > 0:
            factor = 0.5 if level == _WHITE else float(_linear(LEVEL * _WHITE) / _linear(level))
            self.tone = Tone(max(self.tone.exposure * factor**_PART, 1 / clips), self.tone.gains)
        return bool(np.median(codes) < _WHITE) or self.tone.exposure <= 1 / clips


def _linear(code: float) -> Float[np.ndarray, ""]:
    """Return the linear light of an 8-bit sRGB code (IEC 61966-2-1)."""
    value = code / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
