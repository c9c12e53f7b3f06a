"""Check that the exposures of a bracket show the same light."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, UInt16

from udccal.cameras.protocol import Frame
from udccal.sessions.frame_checks import FrameLimits

_SIGNAL_DN = 40.0  # above black; in weaker signals, noise and an uncertain black level dominate
_BELOW_SATURATION = 0.95
_FEWEST_SAMPLES = 8
_BRIGHTNESS = 0.1  # relative
_PATTERN = 0.15  # relative RMS
_PATTERN_CHI2 = 6.0
_DN_PER_e = 1.0  # no camera at 0 dB exceeds this gain, so the noise is not underestimated
_READ_DN = 3.0


def bracket_fault(shorter: Frame, longer: Frame, limits: FrameLimits) -> str | None:
    """Compare two exposures of a small light where the longer one does not clip and the shorter one has signal.

    Args:
        shorter: a good frame.
        longer: the next longer exposure, of the same region.
        limits: black and saturation level.

    Returns:
        ``"motion"`` when the light's pattern changed by more than 15 % and 6 times the variance of noise;
        ``"flicker"`` when its brightness per exposure changed by more than 10 %; None when both agree or too few
        samples can be compared.
    """
    ratio = longer.settings.exposure_s / shorter.settings.exposure_s
    before, after = _light(shorter.data), _light(longer.data)
    useful = (longer.data < _BELOW_SATURATION * limits.saturation_DN) & (before > _SIGNAL_DN)
    if np.count_nonzero(useful) < _FEWEST_SAMPLES:
        return None
    expected, found = ratio * before[useful], after[useful]
    brightness = float(found.sum() / expected.sum())
    change = found / brightness - expected
    variance = _DN_PER_e * expected * (1 + ratio) + (1 + ratio**2) * _READ_DN**2
    relative = float(np.sqrt(np.mean(change**2) / np.mean(expected**2)))
    if relative > _PATTERN and float(np.mean(change**2 / variance)) > _PATTERN_CHI2:
        return "motion"
    return "flicker" if abs(brightness - 1) > _BRIGHTNESS else None


def _light(data: UInt16[np.ndarray, "rows columns"]) -> Float64[np.ndarray, "rows columns"]:
    """Subtract the dark surroundings, which have the black level and dark current of this frame."""
    return data - float(np.median(data))
