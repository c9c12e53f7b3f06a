"""Checks of what the camera sees before a step is captured; their errors are sentences for the person at the rig."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from procedures.readings import dark_limit_DN, evenness, find_corners, find_led, light_leak
from udccal.arrangements import Arrangement, Board, BoardSpec, FlatLight, Led
from udccal.cameras.protocol import Frame
from udccal.errors import CaptureError
from udccal.rig import RigDescription
from udccal.sessions.frame_checks import FrameLimits

Check = Callable[[Frame, RigDescription], None]


class NotDarkError(CaptureError):
    """Light reaches a sensor that is to be in the dark."""


_FAR = 100.0  # times: a camera without the exposure may lend its nearest; milliseconds for seconds are 1000 times off
# Exposures in s at which fast lenses behind a panel fill most of a well. Wells, f-numbers and lights that are in use
# change these by less than a hundred times.
_USUAL_S: Final = {Led: 1e-4, FlatLight: 5e-3, Board: 1e-2}
_PANEL_S: Final = 0.1
_AIM_PX = 10  # the fit searches a little further


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
            f"Expected an exposure near {wanted_s:.3g} s, as follows from the light and the earlier steps, found "
            f"{found_s:.3g} s: {factor:.0f} times too {'long' if found_s > wanted_s else 'short'}. Exposures are in "
            "seconds (s): correct a frames.csv that has milliseconds (ms), here or in an earlier step, or take the "
            "pictures again."
        )


def usual_exposure_s(arrangement: Arrangement) -> float:
    """Return the exposure in s at which an LED, an even light, a board or the panel usually fills most of a well."""
    return _USUAL_S.get(type(arrangement), _PANEL_S)


def is_dark(frame: Frame, rig: RigDescription) -> None:
    """Check that no light reaches the sensor.

    Raises:
        NotDarkError: when the frame is brighter than black level and dark current can make it.
    """
    leak = light_leak(frame, rig)
    if not leak.ok:
        raise NotDarkError(
            f"Expected a dark frame, found at least a part {leak.value - rig.camera.black_DN.tolerance:.0f} DN above "
            "the black level. Cap the lens, switch the panel off and close the blackout, then repeat the step."
        )


def is_even(frame: Frame, rig: RigDescription) -> None:
    """Check that an even light fills the view.

    Raises:
        CaptureError: when a part of the view is much darker than the brightest.
    """
    even = evenness(frame, rig)
    if not even.ok:
        raise CaptureError(
            f"Expected an even light over the whole view, found patches at {even.value:.0f}% of the "
            "brightest. Bring the LED panel closer and centre it, and remove what is in front of it."
        )


def shows_led(x_px: float, y_px: float) -> Check:
    """A check that one small light shines in a dark room, with its image near the intended place on the sensor."""

    def check(frame: Frame, rig: RigDescription) -> None:
        """Find the LED.

        Raises:
            CaptureError: when the room is not dark, or the light lies more than 10 px away.
        """
        led = find_led(frame, rig)
        if not led.room.ok:
            raise CaptureError(
                "Expected an LED in a dark room, found the surroundings nearly as bright. Darken the room, then repeat."
            )
        (x, y), found = (x_px, y_px), led.place_px
        if max(abs(x - found[0]), abs(y - found[1])) > _AIM_PX:
            raise CaptureError(
                f"Expected the LED's image within {_AIM_PX} px of column {x:.0f}, row {y:.0f}, found it at "
                f"column {found[0]:.0f}, row {found[1]:.0f}. {move_led(found, (x, y))}, then repeat the step."
            )

    return check


def move_led(from_px: tuple[float, float], to_px: tuple[float, float]) -> str:
    """Return what to do with an LED for its image to go from one place to another, without a full stop."""
    right, down = (end - start for start, end in zip(from_px, to_px, strict=True))
    return (
        f"Move the LED so that its image goes {abs(right):.0f} px {'right' if right > 0 else 'left'} and "
        f"{abs(down):.0f} px {'down' if down > 0 else 'up'} (as the camera sees it)"
    )


def shows_board(spec: BoardSpec) -> Check:
    """A check that a ChArUco board of this kind is found."""

    def check(frame: Frame, rig: RigDescription) -> None:
        """Find the board.

        Raises:
            CaptureError: when fewer than a quarter of its inner corners (6 to 12) are seen.
        """
        corners = find_corners(frame, spec).reading(spec)
        if not corners.ok:
            raise CaptureError(
                f"Expected to find at least {corners.low:.0f} corners of the {spec.columns} x {spec.rows} ChArUco "
                f"board, found {corners.value:.0f}. Hold the board as described, evenly lit and flat, then repeat the "
                "step."
            )

    return check


def sees_anything(frame: Frame, rig: RigDescription) -> None:
    """Accept every frame: dark pictures on the panel may show nothing."""
