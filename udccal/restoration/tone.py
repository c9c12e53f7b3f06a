"""From linear light to what a display shows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from udccal.arguments import check_array, check_number
from udccal.errors import RestorationError

# A still picture's exposure brings this percentile of its light to this display-encoded value.
PERCENTILE, LEVEL = 97.0, 0.9
_MOST = 1e30
TONE_ADVICE = "Give Tone(display_exposure(picture)), say."


@dataclass(frozen=True)
class Tone:
    """Display encoding sRGB(exposure * gains * linear).

    Attributes:
        exposure: factor from linear light to the display's range, from 0 to 1e30.
        gains: balance the colours (R, G, B); each from 0 to 1e6.

    Raises:
        RestorationError: when one is no such number, or there are not three gains.
    """

    exposure: float
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        check_number(
            self.exposure,
            "an exposure of the display",
            (0.0, _MOST),
            "Try display_exposure of a picture.",
            RestorationError,
        )
        if not isinstance(self.gains, tuple) or len(self.gains) != 3:
            raise RestorationError(
                f"Expected a tuple of three gains, of red, green and blue, found {self.gains!r:.80}. Give three."
            )
        for gain in self.gains:
            check_number(
                gain, "a gain of a colour", (0.0, 1e6), "A gain of 1 leaves the colour as it is.", RestorationError
            )

    def of_electrons(self, exposure_s: float) -> Tone:
        """Return the tone that shows a frame's e- as this one shows its e-/s."""
        return replace(self, exposure=min(self.exposure / exposure_s, _MOST))

    def scale(self) -> Float32[np.ndarray, "3"]:
        """Return the factor of each colour from linear light to the display's range."""
        return np.float32(self.exposure) * np.asarray(self.gains, dtype=np.float32)

    def rgb8(self, linear: Float32[np.ndarray, "rows columns 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
        """Return what a display shows, in 8 bits: ``to_rgb8(apply(linear))`` by a table, within 1 of 255.

        Raises:
            RestorationError: when it is no picture of three colours, or an empty one.
        """
        advice = "Give a restored picture."
        check_array(linear, "a picture", "real numbers", ("rows", "columns", 3), advice, RestorationError)
        if linear.size == 0:
            raise RestorationError(
                f"Expected a picture, found one of {linear.shape[1]} x {linear.shape[0]} px. {advice}"
            )
        # Rounded, and clipped at both ends; beyond the range of 32-bit integers the product would be 0.
        # Reading the picture for its largest value takes a third of the time of a bounded copy, which few need.
        most = 1e4 / max(float(self.scale().max()), 1e-30)
        if cv2.norm(linear, cv2.NORM_INF) > most:
            linear = cv2.threshold(linear, most, most, cv2.THRESH_TRUNC)[1]
        steps = cv2.multiply(linear, (*(self.scale() * (len(CODES) - 1)).tolist(), 0.0), dtype=cv2.CV_16U)
        return cv2.LUT(steps, CODES)

    def apply(self, linear: Float[np.ndarray, "rows columns 3"]) -> Float32[np.ndarray, "rows columns 3"]:
        """Return display-encoded values from 0 to 1."""
        return encode_srgb(linear * self.scale())


def encode_srgb(linear: Float[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Encode ``linear`` light, clipped to 0-1, by the sRGB transfer function (IEC 61966-2-1)."""
    clipped = np.clip(linear, 0.0, 1.0).astype(np.float32)
    root = np.power(np.maximum(clipped, 0.0031308), np.float32(1 / 2.4))
    return np.where(clipped <= 0.0031308, np.float32(12.92) * clipped, np.float32(1.055) * root - np.float32(0.055))


def display_exposure(
    linear: Float[np.ndarray, "rows columns 3"], least: float = 1e-12, clips: float = math.inf
) -> float:
    """Return the factor on ``linear`` light that brings its 97th percentile to the display-encoded value 0.9.

    Where the percentile is below ``least``, it brings this to 0.9. Light from ``clips`` on is white, however much there
    is of it: nothing is known of its detail.

    Raises:
        RestorationError: when the picture is empty, or some of its light is no number.
    """
    level = float(np.percentile(linear, PERCENTILE)) if linear.size else math.nan
    if math.isnan(level):
        raise RestorationError("Expected a picture whose light is numbers, found NaN or no pixel. Give a restored one.")
    return max(((LEVEL + 0.055) / 1.055) ** 2.4 / max(level, least), 1 / clips)


def to_rgb8(display: Float[np.ndarray, "rows columns 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
    """Convert ``display``-encoded values, clipped to 0-1, to 8 bit."""
    return np.rint(np.clip(display, 0.0, 1.0) * 255.0).astype(np.uint8)


# 8-bit sRGB codes of 65536 even steps of linear light from 0 to 1.
CODES = to_rgb8(encode_srgb(np.linspace(0.0, 1.0, 1 << 16)[:, None, None].repeat(3, axis=2)))[:, 0, 0]
