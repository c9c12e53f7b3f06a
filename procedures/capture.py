"""Carrying out a capture plan at a known exposure."""

from __future__ import annotations

from procedures.plans import Bracket, Plan, Singles, Stack
from udccal.cameras.protocol import Camera, Frame, Region, Settings
from udccal.errors import CaptureError
from udccal.rig import RigDescription
from udccal.sessions.averaging import AveragedFrames, average_frames
from udccal.sessions.frame_checks import FrameChecks

_TRIES = 4


def take(
    camera: Camera, region: Region, exposure_s: float, plan: Plan, rig: RigDescription
) -> tuple[Frame | AveragedFrames, ...]:
    """What the plan asks for: single frames, or one average.

    Raises:
        CaptureError: when the camera does not deliver enough usable frames.
    """
    match plan:
        case Stack(frames):
            camera.configure(Settings(exposure_s, 0.0, region))
            checks = FrameChecks(rig.camera.black_DN.value, float(rig.saturation_DN))
            return (average_frames(camera.frames, frames, checks),)
        case Singles(frames):
            camera.configure(Settings(exposure_s, 0.0, region))
            return tuple(_single(camera) for _ in range(frames))
        case Bracket(frames, factor):
            taken = []
            for seconds in _bracket(exposure_s, frames, factor, rig.camera.max_exposure_s):
                camera.configure(Settings(seconds, 0.0, region))
                taken.append(_single(camera))
            return tuple(taken)


def _bracket(first_s: float, frames: int, factor: float, longest_s: float) -> list[float]:
    """Exposures that rise by ``factor``; the last is the camera's longest if the next step would pass it."""
    exposures = [first_s]
    while len(exposures) < frames and exposures[-1] < longest_s:
        exposures.append(min(exposures[-1] * factor, longest_s))
    return exposures


def _single(camera: Camera) -> Frame:
    for _ in range(_TRIES):
        for frame in camera.frames(1):
            if frame.complete:
                return frame
    raise CaptureError(
        f"Expected a complete frame, found {_TRIES} incomplete ones in a row. Check the camera's cable, then repeat."
    )
