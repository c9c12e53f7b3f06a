"""What a live run has done: times of its stages, latency, and frames that were lost."""

from __future__ import annotations

import enum
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import final

from udccal.live.durations import Durations, Spread


class Stage(enum.StrEnum):
    """A thread of a live run."""

    ACQUISITION = "acquisition"
    RESTORATION = "restoration"
    OUTPUT = "output"


@final
@dataclass(frozen=True)
class Figures:
    """Figures of one second, or of the whole run.

    Attributes:
        span: ``second`` or ``whole``.
        elapsed_s: time since the run began.
        captured: frames that the camera delivered or lost.
        written: frames that the sink took.
        dropped_by_camera: frames that the camera lost or delivered incomplete.
        dropped_before_restoration, dropped_before_output: frames that a newer one replaced in a queue.
        late_hooks: frames that went out unaltered because the hook was late.
        without_panel_picture: frames darker than the panel's picture alone, restored as if nobody knew it.
        acquisition_ms: time to the next frame, waiting for the camera included.
        restoration_ms: restoration and display encoding.
        output_ms: hook and sink.
        latency_ms: from the frame's arrival to the end of its writing.
    """

    span: str
    elapsed_s: float
    captured: int
    written: int
    dropped_by_camera: int
    dropped_before_restoration: int
    dropped_before_output: int
    late_hooks: int
    without_panel_picture: int
    acquisition_ms: Spread
    restoration_ms: Spread
    output_ms: Spread
    latency_ms: Spread

    @property
    def dropped(self) -> int:
        """Frames lost anywhere."""
        return self.dropped_by_camera + self.dropped_before_restoration + self.dropped_before_output


@final
@dataclass
class _Sums:
    captured: int = 0
    written: int = 0
    late_hooks: int = 0
    without_panel_picture: int = 0
    dropped: Counter[Stage] = field(default_factory=Counter)
    took: dict[Stage, Durations] = field(default_factory=lambda: {stage: Durations() for stage in Stage})
    latency: Durations = field(default_factory=Durations)

    def figures(self, span: str, elapsed_s: float) -> Figures:
        return Figures(
            span=span,
            elapsed_s=elapsed_s,
            captured=self.captured,
            written=self.written,
            dropped_by_camera=self.dropped[Stage.ACQUISITION],
            dropped_before_restoration=self.dropped[Stage.RESTORATION],
            dropped_before_output=self.dropped[Stage.OUTPUT],
            late_hooks=self.late_hooks,
            without_panel_picture=self.without_panel_picture,
            acquisition_ms=self.took[Stage.ACQUISITION].spread(),
            restoration_ms=self.took[Stage.RESTORATION].spread(),
            output_ms=self.took[Stage.OUTPUT].spread(),
            latency_ms=self.latency.spread(),
        )


@final
class Tally:
    """Counts for all threads, for the present second and for the whole run."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._start_s = time.monotonic()
        self._second, self._whole = _Sums(), _Sums()

    def took(self, stage: Stage, seconds: float) -> None:
        """Count the time of one frame in a stage."""
        with self._lock:
            for sums in (self._second, self._whole):
                sums.took[stage].add(seconds)

    def captured(self, frames: int) -> None:
        """Count frames that the camera delivered or lost."""
        with self._lock:
            for sums in (self._second, self._whole):
                sums.captured += frames

    def dropped(self, stage: Stage, frames: int = 1) -> None:
        """Count frames that were lost in a stage, or waiting for it."""
        with self._lock:
            for sums in (self._second, self._whole):
                sums.dropped[stage] += frames

    def written(self, latency_s: float, late_hook: bool) -> None:
        """Count a frame that the sink took."""
        with self._lock:
            for sums in (self._second, self._whole):
                sums.written += 1
                sums.late_hooks += late_hook
                sums.latency.add(latency_s)

    def without_panel_picture(self) -> None:
        """Count a frame that was darker than the panel's picture alone."""
        with self._lock:
            for sums in (self._second, self._whole):
                sums.without_panel_picture += 1

    def second(self) -> Figures:
        """Return the figures since the last call, and begin anew."""
        with self._lock:
            ended, self._second = self._second, _Sums()
            return ended.figures("second", time.monotonic() - self._start_s)

    def whole(self) -> Figures:
        """Return the figures since the run began."""
        with self._lock:
            return self._whole.figures("whole", time.monotonic() - self._start_s)
