"""Checks of what the camera sees before a step is captured; their errors are sentences for the person at the rig."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from procedures.metering import spot_light
from udccal.arrangements import BoardSpec
from udccal.cameras.protocol import Frame
from udccal.errors import CaptureError
from udccal.rig import RigDescription
from udccal.sessions.frame_checks import FrameLimits
from udccal.sessions.patches import brightest_patch_DN

Check = Callable[[Frame, RigDescription], None]

_STRAY_E = 60.0  # electrons above the nominal black level that a dark frame may show, in addition to the tolerances
_UNEVEN = 0.15  # darkest patch of an even light over the brightest, vignetting included
_FEWEST_CORNERS, _ENOUGH_CORNERS = 6, 12  # a quarter of the board, within these bounds
_FAR = 100.0  # times: a camera without the exposure may lend its nearest; milliseconds for seconds are 1000 times off
_AIM_PX = 10  # the fit searches a little further


def dark_limit_DN(rig: RigDescription, exposure_s: float) -> float:
    """Return the level in DN that no patch of a dark frame exceeds through black level and dark current."""
    camera = rig.camera
    # 100 e-/s over half the sensor is more dark current than any camera within its specification has.
    allowed_e = _STRAY_E + 100.0 * exposure_s
    return camera.black_DN.value + camera.black_DN.tolerance + allowed_e * camera.K_DN_per_e.value


def frame_limits(rig: RigDescription, exposure_s: float, dark: bool) -> FrameLimits:
    """Return the limits of each frame of a step's captures."""
    limits = FrameLimits(rig.camera.black_DN.value, rig.lowest_saturation_DN)
    return replace(limits, dark_DN=dark_limit_DN(rig, exposure_s)) if dark else limits


def refuse_far_exposure(found_s: float, wanted_s: float) -> None:
    """Refuse an exposure that is far off the one that a step is captured at: pictures of files have what they have.

    Raises:
        CaptureError: when it is more than 100 times longer or shorter.
    """
    if not 1 / _FAR <= found_s / wanted_s <= _FAR:
        factor = max(found_s / wanted_s, wanted_s / found_s)
        raise CaptureError(
            f"Expected an exposure near {wanted_s:.3g} s, as follows from the rig and the earlier steps, found "
            f"{found_s:.3g} s: {factor:.0f} times too {'long' if found_s > wanted_s else 'short'}. Exposures are in "
            "seconds (s): correct a frames.csv that has milliseconds (ms), here or in an earlier step, or take the "
            "pictures again."
        )


def is_dark(frame: Frame, rig: RigDescription) -> None:
    """Check that no light reaches the sensor.

    Raises:
        CaptureError: when the frame is brighter than black level and dark current can make it.
    """
    brightest = brightest_patch_DN(frame.data)
    if brightest > dark_limit_DN(rig, frame.settings.exposure_s):
        above_DN = brightest - rig.camera.black_DN.value - rig.camera.black_DN.tolerance
        raise CaptureError(
            f"Expected a dark frame, found at least a part {above_DN:.0f} DN above the black level. "
            "Cap the lens, switch the panel off and close the blackout, then repeat the step."
        )


def is_even(frame: Frame, rig: RigDescription) -> None:
    """Check that an even light fills the view.

    Raises:
        CaptureError: when a part of the view is much darker than the brightest.
    """
    light = _patches(frame) - rig.camera.black_DN.value
    darkest, brightest = float(light.min()), float(light.max())
    if darkest < _UNEVEN * brightest:
        raise CaptureError(
            f"Expected an even light over the whole view, found patches at {max(darkest, 0.0) / brightest:.0%} of the "
            "brightest. Bring the LED panel closer and centre it, and remove what is in front of it."
        )


def shows_led(x_px: float, y_px: float) -> Check:
    """A check that one small light shines in a dark room, with its image near the intended place on the sensor."""

    def check(frame: Frame, rig: RigDescription) -> None:
        """Find the LED.

        Raises:
            CaptureError: when the room is not dark, or the light lies more than 10 px away.
        """
        region, light = frame.settings.region, spot_light(frame.data)
        if float(np.median(frame.data)) - rig.camera.black_DN.value > 0.5 * float(light.max()):
            raise CaptureError(
                "Expected an LED in a dark room, found the surroundings nearly as bright. Darken the room, then repeat."
            )
        row, column = (int(index) for index in np.unravel_index(int(light.argmax()), light.shape))
        right, down = x_px - region.x - column, y_px - region.y - row
        if max(abs(right), abs(down)) > _AIM_PX:
            raise CaptureError(
                f"Expected the LED's image within {_AIM_PX} px of column {x_px:.0f}, row {y_px:.0f}, found it at "
                f"column {region.x + column}, row {region.y + row}. Move the LED so that its image goes "
                f"{abs(right):.0f} px {'right' if right > 0 else 'left'} and {abs(down):.0f} px "
                f"{'down' if down > 0 else 'up'} (as the camera sees it), then repeat the step."
            )

    return check


def shows_board(spec: BoardSpec) -> Check:
    """A check that a ChArUco board of this kind is found."""

    def check(frame: Frame, rig: RigDescription) -> None:
        """Find the board.

        Raises:
            CaptureError: when fewer than a quarter of its inner corners (6 to 12) are seen.
        """
        quarter = (spec.columns - 1) * (spec.rows - 1) // 4
        needed = min(max(quarter, _FEWEST_CORNERS), _ENOUGH_CORNERS)
        found = _corners_seen(frame, spec)
        if found < needed:
            raise CaptureError(
                f"Expected to find at least {needed} corners of the {spec.columns} x {spec.rows} ChArUco board, "
                f"found {found}. Hold the board as described, evenly lit and flat, then repeat the step."
            )

    return check


def sees_anything(frame: Frame, rig: RigDescription) -> None:
    """Accept every frame: dark pictures on the panel may show nothing."""


def _patches(frame: Frame) -> np.ndarray:
    """Return means over about 16 x 16 patches of whole 2 x 2 cells: colour and noise average out."""
    height, width = (2 * max(1, side // 32) for side in frame.data.shape)
    down, across = frame.data.shape[0] // height, frame.data.shape[1] // width
    whole = frame.data[: down * height, : across * width]
    return whole.reshape(down, height, across, width).mean(axis=(1, 3))


def _corners_seen(frame: Frame, spec: BoardSpec) -> int:
    grey = cv2.blur(frame.data.astype(np.float32), (2, 2))  # every 2 x 2 holds each site of the pattern once
    low, high = np.percentile(grey, (0.5, 99.5))
    picture = np.clip((grey - low) / max(float(high - low), 1.0) * 255, 0, 255).astype(np.uint8)
    if min(picture.shape) < 600:  # markers of few pixels are found more reliably in a magnified picture
        picture = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    board = cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_mm, spec.marker_mm, dictionary)
    corners = cv2.aruco.CharucoDetector(board).detectBoard(picture)[0]
    return 0 if corners is None else len(corners)
