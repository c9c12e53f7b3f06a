"""The limits of a comparison: from where on a difference is significant, and from where on it matters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class DiffLimits:
    """Two thresholds that are independent of each other. docs/diff.md gives the reason for each number.

    Attributes:
        chance: probability below which chance does not explain a term's chi-squared.
        errors: an effect beyond this many of its own errors is significant, too: a term's arrays are in no covariance.
        wire_percent: harmless difference of the wire map, RMS over the sensor.
        kernel_percent: of the kernels, relative L2 distance, mean over the places, worst colour.
        backscatter_percent: of the panel's light, RMS over the sensor, of its peak, worst panel picture.
        rays_px: of the place at which a ray of the panel's frame is imaged, 95th percentile over the sensor.
        K_percent, sigma_d_percent, PRNU_percent: of the sensor's gain, dark noise and photo-response non-uniformity.
        black_sigma_d: of the black level, in units of the dark noise of one sample.
        picture_dB: loss of a picture that is restored with the other profile's term.
        pitch_sigma: sigma of the panel's place by backscatter, in pitches, up to which it tells whole pitches.
    """

    chance: float = 1e-3
    errors: float = 4.0
    wire_percent: float = 0.2
    kernel_percent: float = 3.0
    backscatter_percent: float = 2.0
    rays_px: float = 0.15
    K_percent: float = 1.0
    sigma_d_percent: float = 3.0
    PRNU_percent: float = 5.0
    black_sigma_d: float = 0.5
    picture_dB: float = 0.1
    pitch_sigma: float = 0.1
