"""Carries out a capture plan at a known exposure; rejected frames are left out, counted and replaced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from procedures.plans import Bracket, Plan, Singles, Stack
from udccal.cameras.protocol import Camera, Frame, Region, Settings
from udccal.errors import CaptureError
from udccal.sessions.averaging import average_frames
from udccal.sessions.bracket_checks import bracket_fault
from udccal.sessions.captured import Capture, SingleFrame
from udccal.sessions.frame_checks import FrameChecks, FrameLimits, frames_agree

_TRIES = 4
_AGREEMENT = 0.01  # relative difference of the mean light of single frames of one scene


def take(
    camera: Camera, region: Region, exposure_s: float, plan: Plan, limits: FrameLimits, longest_s: float
) -> tuple[Capture, ...]:
    """Capture what the plan requires: single frames, or one average.

    Args:
        camera: open camera.
        region: region of the sensor.
        exposure_s: exposure of the first frame.
        plan: frames to take.
        limits: limits of each frame; single frames may clip, since some are taken for that.
        longest_s: longest exposure of a bracket.

    Raises:
        CaptureError: when the camera does not deliver enough usable frames.
    """
    settings = Settings(exposure_s, 0.0, region)
    clipping = replace(limits, max_saturated_fraction=1.0)
    match plan:
        case Stack(frames):
            return (average_frames(camera.frames, frames, FrameChecks(limits, camera.configure(settings))),)
        case Singles(frames):
            return _singles(camera, frames, FrameChecks(clipping, camera.configure(settings)), limits.black_DN)
        case Bracket():
            return _exposures(camera, settings, plan.exposures_s(exposure_s, longest_s), clipping)


def _singles(camera: Camera, count: int, checks: FrameChecks, black_DN: float) -> tuple[SingleFrame, ...]:
    """Return frames of one scene and setting whose light agrees; the first carries the rejected ones."""
    frames: list[Frame] = []
    for _ in range(_TRIES):
        frames += checks.sound(camera.frames(count - len(frames)))
        if len(frames) < count:
            continue
        if frames_agree(frames, black_DN, _AGREEMENT):
            return (SingleFrame(frames[0], checks.rejections()), *(SingleFrame(frame) for frame in frames[1:]))
        for _ in frames:  # it is not known which of them is right
            checks.reject("flicker")
        frames = []
    raise CaptureError(_sentence("a steady light", checks))


def _exposures(
    camera: Camera, settings: Settings, exposures: Sequence[float], limits: FrameLimits
) -> tuple[SingleFrame, ...]:
    """Return one frame per exposure, all of the same light; fewer where the camera has no longer one, as with files."""
    taken: list[SingleFrame] = []
    for exposure_s in exposures:
        accepted = camera.configure(replace(settings, exposure_s=exposure_s))
        if taken and accepted.exposure_s <= taken[-1].frame.settings.exposure_s:
            break
        taken.append(_next_exposure(camera, FrameChecks(limits, accepted), taken, limits))
    return tuple(taken)


def _next_exposure(camera: Camera, checks: FrameChecks, taken: list[SingleFrame], limits: FrameLimits) -> SingleFrame:
    """Return a frame with the same light as the one before."""
    for _ in range(_TRIES):
        for frame in checks.sound(camera.frames(1)):
            reason = bracket_fault(taken[-1].frame, frame, limits) if taken else None
            if reason is None:
                return SingleFrame(frame, checks.rejections())
            checks.reject(reason)
    raise CaptureError(_sentence("a usable frame", checks))


def _sentence(expected: str, checks: FrameChecks) -> str:
    found = checks.summary() or "no frame at all"
    return (
        f"Expected {expected}, found only frames that had to be rejected ({found}). "
        "Check the light and the camera's cable, and that nothing moves, then repeat the step."
    )
