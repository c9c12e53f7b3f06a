"""What makes the exposure of a frame doubtful, whether the picture on the panel is known or not."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt16

from udccal.models.noise import Noise, scalar
from udccal.profiles.profile import Profile
from udccal.restoration.linear import variance_floor_e2
from udccal.restoration.panel_mask import BLOCK, PERCENTILE, SIGMAS
from udccal.rig import Camera

# Cameras round their exposures.
_ROUNDED = 1.01
# Dark places are darker than darkness where they have less than this part of the dark signal, and lack more than this
# part of the range above black: black levels drift by a code or two of 12 bits.
_PART, _DRIFT = 0.5, 1e-3


def exposure_doubts(mosaic: UInt16[np.ndarray, "rows columns"], exposure_s: float, profile: Profile) -> tuple[str, ...]:
    """Return a sentence for each reason to doubt that a frame was exposed for so long; none where there is no reason.

    Light and dark current only add. So the darkest places of a frame show at least the dark signal of its exposure, and
    less than half of it is no darkness at that exposure, at about the temperature of the calibration. Nothing is told
    of a frame without dark places, nor with a sensor that takes its dark signal off by itself: its dark current is 0.

    Args:
        mosaic: a frame that fits the rig, in DN.
        exposure_s: what is said to be its exposure.
        profile: the rig as measured.
    """
    range_doubt = _out_of_range(exposure_s, profile.rig.camera)
    dark_doubt = "" if profile.noise.unfitted else _darker_than_dark(mosaic, exposure_s, profile.noise.term)
    return tuple(filter(None, (range_doubt, dark_doubt)))


def _out_of_range(exposure_s: float, camera: Camera) -> str:
    low, high = camera.min_exposure_s, camera.max_exposure_s
    if low / _ROUNDED <= exposure_s <= high * _ROUNDED:
        return ""
    return (
        f"The rig's camera exposes from {low:g} s to {high:g} s, and not for {exposure_s:g} s. Check that the exposure "
        "is in seconds (8 ms are 0.008)."
    )


def _darker_than_dark(mosaic: UInt16[np.ndarray, "rows columns"], exposure_s: float, noise: Noise) -> str:
    K, black_DN = scalar(noise.K_DN_per_e), scalar(noise.black_DN)
    dark_e = scalar(noise.dark_current_e_per_s) * exposure_s
    down, across = (max(size // BLOCK, 1) for size in mosaic.shape)
    blocks = cv2.resize(mosaic.astype(np.float32), (across, down), interpolation=cv2.INTER_AREA)
    # Of some thousand blocks, the darkest are dark by noise.
    seen_e = (float(np.percentile(blocks, PERCENTILE)) - black_DN) / K
    most_e = seen_e + SIGMAS * (variance_floor_e2(noise, exposure_s) + max(seen_e, 0.0)) ** 0.5 / BLOCK
    drift_e = _DRIFT * (scalar(noise.saturation_DN) - black_DN) / K
    if most_e >= _PART * dark_e or dark_e - most_e <= drift_e:
        return ""
    return (
        f"The frame's darkest places have {seen_e:.3g} e- above black, where darkness alone gives {dark_e:.3g} e- in "
        f"{exposure_s:g} s. Check that the exposure is in seconds (8 ms are 0.008), that the samples are as the camera "
        "delivered them, and that the camera is about as warm as it was when it was calibrated."
    )
