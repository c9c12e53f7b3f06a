"""Light from a simulated rig."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import UInt16

from tests.virtual_u3v.model import CameraModel
from tests.virtual_u3v.sources import Exposure
from udccal.simulation.world import SimulatedWorld


@final
class RigSource:
    """Frames of a simulated rig, with whatever is arranged in front of it when each is exposed."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world

    def __call__(self, exposure: Exposure) -> UInt16[np.ndarray, "rows columns"]:
        settings = exposure.settings
        # The world's own count of frames: block ids begin anew with each acquisition, and with them the noise would.
        frame_id, timestamp_s = self._world.next_frame(settings.exposure_s)
        rate = self._world.rate_during(settings, timestamp_s)
        return self._world.develop(rate, settings, frame_id)


def model_of_rig(world: SimulatedWorld) -> CameraModel:
    """The camera that stands in a simulated rig."""
    camera = world.truth.description.camera
    return CameraModel(
        columns=camera.columns,
        rows=camera.rows,
        cfa=camera.cfa,
        bits=camera.bits,
        exposure_us=(camera.min_exposure_s * 1e6, camera.max_exposure_s * 1e6),
        frame_rate_hz=(0.1, camera.frame_rate_hz),
    )
