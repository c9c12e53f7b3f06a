"""When a change of a rig is significant, and from where on it matters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class DriftLimits:
    """Two kinds of thresholds that are independent of each other. docs/check.md gives the reason for each number.

    Attributes:
        chance: probability below which chance does not explain a change of the camera's pose.
        errors: another change is significant beyond this many of its sigmas.
        moved_mm, turned_deg, focus_percent: harmless movement, turn, and change of the focal length.
        smudge_percent: harmless loss of light in the worst part of the sensor.
        panel_percent, gain_percent: harmless change of the panel's brightness and of the sensor's gain.
    """

    chance: float = 1e-3
    errors: float = 4.0
    moved_mm: float = 0.03
    turned_deg: float = 0.02
    focus_percent: float = 0.05
    smudge_percent: float = 1.0
    panel_percent: float = 2.0
    gain_percent: float = 1.0
