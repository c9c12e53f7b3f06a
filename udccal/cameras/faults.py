"""Faults of a simulated camera; each is off by default."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class CameraFaults:
    """Faults of a simulated camera. Frames are counted from 0 over the camera's whole life, across openings.

    Attributes:
        incomplete_every: period of frames that arrive without their lower half; 0 for never.
        repeat_every: period of frames that are replaced by the one before, with its number; 0 for never.
        time_out_at_frame: this frame never comes; the next one does.
        unplug_at_frame: from this frame on the camera is gone, until it is opened again.
    """

    incomplete_every: int = 0
    repeat_every: int = 0
    time_out_at_frame: int | None = None
    unplug_at_frame: int | None = None

    def cuts(self, frame: int) -> bool:
        """Whether this frame arrives incomplete."""
        return _is_last_of(frame, self.incomplete_every)

    def repeats(self, frame: int) -> bool:
        """Whether the frame before replaces this one."""
        return frame > 0 and _is_last_of(frame, self.repeat_every)


def _is_last_of(frame: int, every: int) -> bool:
    return every > 0 and frame % every == every - 1
