"""Smoothing that adapts to the local brightness.

One smoothness suits one brightness: in the dark, noise is large relative to the contrasts of a scene. The deblurred
picture is therefore filtered to a few greater smoothnesses, each by the ratio of two Wiener filters of the mean kernel.
Every pixel interpolates between the two that suit its own brightness.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32

from udccal.restoration.deblur import RIDGE, Deblurrer

_STEP, _STEPS = 4.0, 7
# One sigma of the Gaussian over which brightness is averaged.
_LEVEL_SIGMA_PX = 3.0


def adapted(
    deblurrer: Deblurrer,
    picture: Float32[np.ndarray, "rows columns"],
    smoothness: float,
    noise_floor_e2: float,
    contrast: float,
) -> Float32[np.ndarray, "rows columns"]:
    """Smooth a deblurred channel further where it is dark.

    Args:
        deblurrer: the channel's deblurrer.
        picture: its solution in e-.
        smoothness: smoothness of that solution; no pixel gets less.
        noise_floor_e2: variance of a dark sample in e-^2.
        contrast: expected RMS difference of neighbours relative to the local brightness.
    """
    level = np.maximum(cv2.GaussianBlur(np.maximum(picture, 0.0), (0, 0), _LEVEL_SIGMA_PX), 1.0)
    wanted = (level + np.float32(noise_floor_e2)) / (np.float32(contrast) * level) ** 2
    steps = np.log(np.maximum(wanted / np.float32(smoothness), 1.0)) / np.float32(np.log(_STEP))
    steps = np.minimum(steps, np.float32(_STEPS - 1))
    canvas = deblurrer.blur.canvas
    spectrum = canvas.transform(canvas.extended(picture))
    present = deblurrer.mean_power + np.float32(smoothness) * deblurrer.difference_power + np.float32(RIDGE)
    result = picture * np.maximum(1.0 - steps, 0.0)
    for step in range(1, _STEPS):
        # The weight of a filtered picture is a hat function of the step: 1 at its own, 0 at its neighbours.
        share = np.maximum(1.0 - np.abs(steps - np.float32(step)), 0.0)
        if not share.any():
            continue
        greater = np.float32(smoothness * _STEP**step)
        gain = present / (deblurrer.mean_power + greater * deblurrer.difference_power + np.float32(RIDGE))
        result += share * canvas.frame(canvas.inverse(spectrum * gain))
    return result
