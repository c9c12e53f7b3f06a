"""Averages of many frames in constant memory, with unusable frames replaced."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import final

import cv2
import numpy as np
from jaxtyping import Float32, UInt16

from udccal.cameras.protocol import Frame
from udccal.errors import CaptureError, UdccalError
from udccal.sessions.captured import AveragedFrames
from udccal.sessions.frame_checks import FrameChecks

MAX_FRAMES = 40_000  # sums of 16-bit samples fit 32 bits, and (sum of samples)^2 fits 64
_DELIVERIES = 8  # each requests only the frames that are still missing
_ENOUGH_TO_TELL = 8  # frames of one delivery; if all of them are unusable, the rest will be too


@final
class RunningMoments:
    """Exact sums of integers: mean and variance are rounded only when they are returned."""

    def __init__(self, rows: int, columns: int) -> None:
        """Start empty for frames of this size."""
        self._sum = np.zeros((rows, columns), np.uint32)
        # Integers below 2^53 are exact in floating point, for which OpenCV has a fast accumulator.
        self._squares = np.zeros((rows, columns), np.float64)
        self.frames = 0

    def add(self, data: UInt16[np.ndarray, "rows columns"]) -> None:
        """Add one frame, in DN."""
        np.add(self._sum, data, out=self._sum)
        cv2.accumulateSquare(data, self._squares)
        self.frames += 1

    def mean(self) -> Float32[np.ndarray, "rows columns"]:
        """Return the mean in DN."""
        return (self._sum / self.frames).astype(np.float32)

    def variance(self) -> Float32[np.ndarray, "rows columns"]:
        """Return the unbiased sample variance in DN^2; at least two frames are needed."""
        count = self.frames
        exact = count * self._squares.astype(np.int64) - self._sum.astype(np.int64) ** 2
        return (exact / (count * (count - 1))).astype(np.float32)


def average_frames(deliver: Callable[[int], Iterator[Frame]], count: int, checks: FrameChecks) -> AveragedFrames:
    """Average ``count`` good frames; bad ones are counted with their reason and replaced.

    Args:
        deliver: method ``frames`` of a configured camera.
        count: number of frames to average.
        checks: checks that accept or reject a frame.

    Returns:
        mean in DN and variance in DN^2, with the settings and the rejected frames.

    Raises:
        UdccalError: when ``count`` is out of range.
        CaptureError: when too many frames were left out.
        CameraError: from the camera.
    """
    if not 2 <= count <= MAX_FRAMES:
        raise UdccalError(f"Expected between 2 and {MAX_FRAMES} frames to average, found {count}. Change the plan.")
    moments: RunningMoments | None = None
    ends: list[Frame] = []
    for _ in range(_DELIVERIES):
        before = moments.frames if moments is not None else 0
        wanted = count - before
        for frame in checks.accepted(deliver(wanted), wanted):
            moments = moments or RunningMoments(*frame.data.shape)
            moments.add(frame.data)
            ends = [*ends[:1], frame]
        if moments is not None and moments.frames == count:
            return AveragedFrames(
                mean=moments.mean(),
                variance=moments.variance(),
                frames=count,
                settings=ends[0].settings,
                first_timestamp_s=ends[0].timestamp_s,
                last_timestamp_s=ends[-1].timestamp_s,
                rejected=checks.rejections(),
                temperature_C=ends[-1].temperature_C,
            )
        if wanted >= _ENOUGH_TO_TELL and (moments.frames if moments is not None else 0) == before:
            break  # the cause will remain: a lamp that changed for good, or a scene that clips
    raise CaptureError(
        f"Expected {count} usable frames, found that too many were left out "
        f"({checks.summary() or 'the camera delivered too few'}). "
        "Check the light, the exposure and the camera's cable, then repeat the step."
    )
