"""Frames to look at while a person sets something up, at an exposure that follows the light."""

from __future__ import annotations

from typing import final

from procedures.metering import even_level, next_exposure_s, spot_level, trial_frame
from procedures.plans import Metered
from udccal.cameras.protocol import Camera, Frame, Region
from udccal.rig import RigDescription

# A longer exposure would keep a person waiting.
LONGEST_S = 0.25
_MOST_TRIALS = 6
_CLOSE = 0.3  # relative change of the exposure that needs no further frame


@final
class LiveFrames:
    """Takes one frame after the other; each exposure brings the light of the frame before to the plan's target."""

    def __init__(self, camera: Camera, region: Region, plan: Metered, rig: RigDescription) -> None:
        self._camera, self._region, self._plan, self._rig = camera, region, plan, rig
        self._exposure_s = min(30 * rig.camera.min_exposure_s, rig.camera.max_exposure_s)

    def next(self) -> tuple[Frame, float]:
        """Return a frame, and its level: 0 at black, 1 at saturation; a sudden change of the light takes a few.

        Raises:
            CaptureError: when three in a row are incomplete.
        """
        for _ in range(_MOST_TRIALS):
            frame, level = self._one()
            if abs(self._exposure_s / frame.settings.exposure_s - 1) < _CLOSE:
                break
        return frame, level

    def _one(self) -> tuple[Frame, float]:
        """Take a frame, and set the exposure of the next one."""
        camera = self._rig.camera
        longest_s = max(camera.min_exposure_s, min(LONGEST_S, camera.max_exposure_s))
        frame = trial_frame(self._camera, self._region, self._exposure_s)
        level = (even_level if self._plan.signal == "even" else spot_level)(frame.data, self._rig)
        wanted_s = next_exposure_s(frame.settings.exposure_s, level, self._plan.target)
        self._exposure_s = min(max(wanted_s, camera.min_exposure_s), longest_s)
        return frame, level
