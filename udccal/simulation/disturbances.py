"""What goes wrong while a technician measures; each disturbance is off unless asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from udccal.simulation.truth import RigTruth


@dataclass(frozen=True)
class Disturbances:
    """Disturbances of a simulated session.

    Attributes:
        flicker_fraction: amplitude of the flat light's flicker, relative. flicker_hz: its frequency.
        leak_e_per_s: light that reaches the sensor past the panel, in every arrangement, the dark one too.
        dropped_frame_every: every so many frames one is lost on the way; 0 for never.
        knock_at_frame: from this frame on the camera stands elsewhere. knock_mm: by how much (panel axes).
    """

    flicker_fraction: float = 0.0
    flicker_hz: float = 100.0
    leak_e_per_s: float = 0.0
    dropped_frame_every: int = 0
    knock_at_frame: int | None = None
    knock_mm: tuple[float, float, float] = (0.0, 0.05, 0.0)

    def flicker(self, timestamp_s: float, exposure_s: float) -> float:
        """Mean brightness of the flat light over one exposure that starts at ``timestamp_s``."""
        phase = 2 * np.pi * self.flicker_hz * (timestamp_s + exposure_s / 2)
        return float(1 + self.flicker_fraction * np.cos(phase) * np.sinc(self.flicker_hz * exposure_s))

    def drops(self, frame_id: int) -> bool:
        """Whether this frame never arrives."""
        return self.dropped_frame_every > 0 and frame_id % self.dropped_frame_every == self.dropped_frame_every - 1

    def knocked(self, frame_id: int) -> bool:
        """Whether the camera has been knocked by the time of this frame."""
        return self.knock_at_frame is not None and frame_id >= self.knock_at_frame


def knock(truth: RigTruth, by_mm: tuple[float, float, float]) -> RigTruth:
    """The same rig with its camera moved."""
    return replace(truth, optics=replace(truth.optics, pupil_mm=truth.optics.pupil_mm + np.asarray(by_mm)))
