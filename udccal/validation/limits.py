"""The limits of a validation: what chance explains, and from where on an error of a prediction matters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class ValidationLimits:
    """Limits of the checks. docs/validate.md gives the reason for each number.

    Attributes:
        chance: probability below which chance does not explain a chi-squared or a pattern.
        chi2_factor: chi-squared may be this many times that of the profile's own fit. Scatter of corners and model
            errors are known to some tens of per cent only.
        board_factor: the same for corners of boards, which hands hold and light meets unequally.
        K_percent: of the gain by the session's flats.
        dark_sigma_d: of black level and dark signal, in units of the dark noise of one sample.
        rays_px: of a pattern in the places of board corners.
        jig_deg: angle between camera and panel by the board on its jig.
        wire_percent: of a pattern in flats that are divided by the wire map, RMS over the sensor.
        cell_percent: of such a flat's worst cell: a smudge, dust, or a changed shading.
        kernel_percent: of an LED's picture, relative L2, worst colour.
        kernel_pattern_percent: of what LEDs' pictures share beyond noise, RMS relative to their light.
        backscatter_percent: of the panel's light, RMS over the sensor, of its peak, worst picture.
        panel_percent: of the panel's brightness, worst colour.
        panel_pattern_percent: of a pattern over the sensor in the panel's light, RMS, of each picture's peak.
    """

    chance: float = 1e-3
    chi2_factor: float = 1.5
    board_factor: float = 4.0
    K_percent: float = 1.0
    dark_sigma_d: float = 0.5
    rays_px: float = 0.15
    jig_deg: float = 0.1
    wire_percent: float = 0.2
    cell_percent: float = 1.0
    kernel_percent: float = 3.0
    kernel_pattern_percent: float = 1.5
    backscatter_percent: float = 2.0
    panel_percent: float = 2.0
    panel_pattern_percent: float = 0.5
