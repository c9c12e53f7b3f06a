"""Finds an exposure by a few test frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt16

from procedures.plans import Metered
from udccal.cameras.protocol import Camera, Frame, Region, Settings
from udccal.errors import CaptureError
from udccal.rig import RigDescription

_MOST_TEST_FRAMES = 16
_CLIPPED = 0.88  # of the range: tolerances of full well and gain leave the true level uncertain
_BURIED = 0.02  # of the range: below it the true level is too uncertain to scale by
_CLOSE = 0.05  # accepted relative distance from the target
_ENOUGH = 0.25  # least fraction of the target at the longest exposure

_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)

Level = Callable[[UInt16[np.ndarray, "rows columns"], RigDescription], float]


@dataclass(frozen=True)
class Exposed:
    """An exposure and its test frame."""

    exposure_s: float
    frame: Frame


def trial_frame(camera: Camera, region: Region, exposure_s: float) -> Frame:
    """Return one complete frame at an exposure.

    Raises:
        CaptureError: when three in a row are incomplete.
    """
    camera.configure(Settings(exposure_s, 0.0, region))
    for _ in range(3):
        for frame in camera.frames(1):
            if frame.complete:
                return frame
    raise CaptureError("Expected a complete test frame, found three incomplete ones. Check the camera's cable.")


def meter(camera: Camera, region: Region, plan: Metered, rig: RigDescription, start_s: float | None = None) -> Exposed:
    """Find the exposure at which the signal of what stands before the camera reaches the plan's target.

    Args:
        camera: takes the test frames.
        region: part of the sensor to measure.
        plan: signal to measure, and its target between black (0) and saturation (1).
        rig: black level, bits and the limits of the exposure.
        start_s: first guess, e.g. the exposure of an earlier step.

    Raises:
        CaptureError: when the signal is clipped at the shortest exposure or too weak at the longest.
    """
    shortest, longest = rig.camera.min_exposure_s, rig.camera.max_exposure_s
    level_of = even_level if plan.signal == "even" else spot_level
    exposure = min(max(start_s or 30 * shortest, shortest), longest)
    tried: set[float] = set()
    for _ in range(_MOST_TEST_FRAMES):
        frame = trial_frame(camera, region, float(exposure))
        exposure = frame.settings.exposure_s
        level = level_of(frame.data, rig)
        bounded = min(max(next_exposure_s(exposure, level, plan.target), shortest), longest)
        if abs(bounded / exposure - 1) < _CLOSE and level <= _CLIPPED:
            _refuse_dark(level, plan, exposure)
            return Exposed(exposure, frame)
        if exposure in tried and level <= _CLIPPED:  # the camera has no nearer exposure: files, coarse steps
            _refuse_dark(level, plan, exposure)
            return Exposed(exposure, frame)
        if bounded == exposure or exposure in tried:
            raise CaptureError(
                f"Expected a signal below saturation, found it clipped at the shortest exposure of {exposure:.3g} s. "
                "Dim the light or stop the lens down, then repeat the step."
            )
        tried.add(exposure)
        exposure = bounded
    raise CaptureError(
        f"Expected a steady light, found that {_MOST_TEST_FRAMES} test frames did not converge to an exposure. "
        "Check that the light does not flicker or move, then repeat the step."
    )


def next_exposure_s(exposure_s: float, level: float, target: float) -> float:
    """Return the exposure that brings the light, which is at ``level`` now, nearer to ``target``."""
    if level > _CLIPPED:
        return exposure_s / 8
    return exposure_s * (8 if level < _BURIED else target / level)


def even_level(data: UInt16[np.ndarray, "rows columns"], rig: RigDescription) -> float:
    """Return the level of the brightest channel of an even field (99.9th percentile), 0 at black, 1 at saturation."""
    return _fraction(float(np.percentile(data, 99.9)), rig)


def spot_level(data: UInt16[np.ndarray, "rows columns"], rig: RigDescription) -> float:
    """Return the level of the brightest sample of a small light in a dark region, 0 at black, 1 at saturation."""
    return _fraction(float(np.median(data)) + float(spot_light(data).max()), rig)


def spot_light(data: UInt16[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Return samples above their surroundings in DN, with hot pixels limited.

    A hot pixel is isolated while a light spreads: a sample counts at most ten times as much as its brightest
    neighbour.
    """
    above = np.maximum(data - float(np.median(data)), 0.0)
    return np.minimum(above, 10.0 * cv2.dilate(above, _NEIGHBOURS))


def _refuse_dark(level: float, plan: Metered, exposure_s: float) -> None:
    if level < _ENOUGH * plan.target:
        what = "light" if plan.signal == "even" else "LED"
        raise CaptureError(
            f"Expected to see the {what}, found only {max(level, 0.0):.1%} of the range at the longest exposure of "
            f"{exposure_s:.3g} s. Check that it is switched on and inside the camera's view, then repeat the step."
        )


def saturation_DN(rig: RigDescription) -> float:
    """Return the nominal level in DN at which a sample clips: the converter's end or the full well, if lower."""
    camera = rig.camera
    return min(float(rig.saturation_DN), camera.black_DN.value + camera.K_DN_per_e.value * camera.full_well_e.value)


def _fraction(level_DN: float, rig: RigDescription) -> float:
    black = rig.camera.black_DN.value
    return (level_DN - black) / (saturation_DN(rig) - black)
