"""What a frame shows of a set-up, as numbers with the bounds in which they are right; checks and guides share them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Float, Int, Shaped

from procedures.metering import spot_light
from udccal.arrangements import BoardSpec
from udccal.board.charuco import board_points_mm, charuco_board
from udccal.cameras.protocol import Frame
from udccal.guide.events import Outline, Reading
from udccal.mounting import nominal_rotation
from udccal.rig import RigDescription
from udccal.sessions.patches import brightest_patch_DN

_STRAY_E = 60.0  # electrons above the nominal black level that a dark frame may show, in addition to the tolerances
_UNEVEN = 15.0  # % of an even light's brightest patch that the darkest has at least, vignetting included
_ROOM = 50.0  # % of an LED's light that its surroundings may have
_FEWEST_CORNERS, _ENOUGH_CORNERS = 6, 12  # a quarter of the board, within these bounds
_LEAST_HEAD_ROOM = 12.0  # %: tolerances of full well and gain leave the true level uncertain
# Looks over which a board must be still, and how far its corners may move.
STILL_LOOKS: Final = 3
_STILL_PX, _UNKNOWN_PX, _FEWEST_COMMON = 1.0, math.inf, 4
_LEAN_DEG = 2.0  # of a board on the jig, beyond the mounting's tolerances: the lens's distortion turns it
_MAGNIFIED_BELOW_PX = 600  # markers of few pixels are found more reliably in a magnified picture
# Half the side of the window in which an LED's place is measured.
_ABOUT_PX: Final = 12
_CORE_PX: Final = 4.0
_CENTRING: Final = 8  # rounds
# Half the side of the window in which an LED's picture is compared, and how much of it may change. Behind rows that
# diffract it finely it changes by 8 to 23 % when it moves by 0.1 px; a smooth spot changes by 10 % at 0.2 px.
_PICTURE_PX: Final = 8
_CHANGED, _MOST_CHANGED, _READ_DN = 0.1, 0.5, 3.0


@final
@dataclass(frozen=True)
class LedSeen:
    """The brightest small light of a frame.

    Attributes:
        place_px: its (x, y) on the sensor; some tenths of a pixel off, as colours sample it at different places.
        peak_DN: its brightest sample above its surroundings.
        room_DN: level of its surroundings above black.
    """

    place_px: tuple[float, float]
    peak_DN: float
    room_DN: float

    @property
    def room(self) -> Reading:
        """Light of the room, as a part of the LED's."""
        return Reading("room light", 100 * self.room_DN / max(self.peak_DN, 1.0), None, _ROOM, "%")


@final
@dataclass(frozen=True)
class CornersSeen:
    """Inner corners of a ChArUco board: their numbers on the board, and (x, y) on the sensor in px."""

    numbers: Int[np.ndarray, " corners"]
    points_px: Float[np.ndarray, "corners 2"]

    def reading(self, spec: BoardSpec) -> Reading:
        """How many are seen; a quarter of the board's is enough, 6 to 12."""
        quarter = (spec.columns - 1) * (spec.rows - 1) // 4
        needed = min(max(quarter, _FEWEST_CORNERS), _ENOUGH_CORNERS)
        return Reading("corners seen", float(len(self.numbers)), float(needed), None, "")

    @property
    def outlines(self) -> tuple[Outline, ...]:
        """The polygon around all corners; none where none is seen."""
        if not len(self.numbers):
            return ()
        hull = cv2.convexHull(self.points_px.astype(np.float32)).reshape(-1, 2)
        return (Outline(tuple((float(x), float(y)) for x, y in hull), "seen"),)


def dark_limit_DN(rig: RigDescription, exposure_s: float) -> float:
    """Return the level in DN that no patch of a dark frame exceeds through black level and dark current."""
    camera = rig.camera
    # 100 e-/s over half the sensor is more dark current than any camera within its specification has.
    allowed_e = _STRAY_E + 100.0 * exposure_s
    return camera.black_DN.value + camera.black_DN.tolerance + allowed_e * camera.K_DN_per_e.value


def light_leak(frame: Frame, rig: RigDescription) -> Reading:
    """Return the level of the brightest patch above black."""
    black = rig.camera.black_DN.value
    limit = dark_limit_DN(rig, frame.settings.exposure_s)
    return Reading("light leak", brightest_patch_DN(frame.data) - black, None, limit - black, "DN")


def evenness(frame: Frame, rig: RigDescription) -> Reading:
    """Return the light of the darkest patch as a part of the brightest's."""
    light = _patches(frame) - rig.camera.black_DN.value
    darkest, brightest = max(float(light.min()), 0.0), max(float(light.max()), 1e-3)
    return Reading("evenness", 100 * darkest / brightest, _UNEVEN, None, "%")


def head_room(level: float, target: float | None) -> Reading:
    """Return how far a level (0 at black, 1 at saturation) lies below saturation; a target bounds it from above too."""
    most = None if target is None else 100 * (1 - 0.25 * target)
    return Reading("head-room", 100 * (1 - level), _LEAST_HEAD_ROOM, most, "%")


def find_led(frame: Frame, rig: RigDescription) -> LedSeen:
    """Return the brightest small light of a frame; hot pixels are too narrow to count."""
    light = spot_light(frame.data)
    row, column = (int(index) for index in np.unravel_index(int(light.argmax()), light.shape))
    surroundings_DN = float(np.median(frame.data)) - rig.camera.black_DN.value
    region = frame.settings.region
    # Where all light has one level, or single samples alone stick out, there is nothing to weigh.
    x, y = _centroid(light, column, row) if light[row, column] > 0 else (float(column), float(row))
    return LedSeen((region.x + x, region.y + y), float(light[row, column]), surroundings_DN)


def led_change(before: Frame, after: Frame, rig: RigDescription) -> Reading:
    """Return the RMS part of an LED's picture that is no multiple of its picture in an earlier frame of one region.

    Brightness and exposure do not count, and the bound allows for the noise of both frames. Movement is judged by this,
    since pixels sample the colours of a fine pattern unevenly: 0.3 px move a centroid by 0.02 to 1.5 px.
    """
    one, other = (spot_light(frame.data) for frame in (before, after))
    peak = np.unravel_index(int(other.argmax()), other.shape)
    window = tuple(slice(max(0, int(at) - _PICTURE_PX), int(at) + _PICTURE_PX + 1) for at in peak)
    one, other = one[window], other[window]
    scale = float((one * other).sum() / max(float((one**2).sum()), 1.0))
    power = max(float((other**2).sum()), 1.0)
    changed = np.sqrt(((other - scale * one) ** 2).sum() / power)
    shot = rig.camera.K_DN_per_e.value * (other + scale**2 * one).sum()
    noise_2 = (shot + (1 + scale**2) * _READ_DN**2 * other.size) / power
    most = min(np.sqrt(_CHANGED**2 + 3 * noise_2), _MOST_CHANGED)
    return Reading("change of the LED's picture", 100 * float(changed), None, 100 * float(most), "%")


def find_corners(frame: Frame, spec: BoardSpec) -> CornersSeen:
    """Return the inner corners of a board that a frame shows."""
    seen, region = corners_in(frame.data, spec), frame.settings.region
    return CornersSeen(seen.numbers, seen.points_px + np.array([region.x, region.y]))


def corners_in(mosaic: Shaped[np.ndarray, "rows columns"], spec: BoardSpec) -> CornersSeen:
    """Return the inner corners of a board that a mosaic shows, in px of the mosaic."""
    picture, scale = _picture(mosaic)
    corners, numbers = cv2.aruco.CharucoDetector(charuco_board(spec)).detectBoard(picture)[:2]
    if corners is None:
        return CornersSeen(np.zeros(0, np.int64), np.zeros((0, 2)))
    # The blur of 2 x 2 moves a picture by half a pixel, the magnification by another.
    points = (np.asarray(corners, np.float64).reshape(-1, 2) - (scale - 1) / 2) / scale - 0.5
    return CornersSeen(np.asarray(numbers, np.int64).reshape(-1), points)


def movement(looks: Sequence[CornersSeen]) -> Reading:
    """Return the largest movement of a corner over the last looks; unknown, and too large, before there are enough."""
    moved = _UNKNOWN_PX
    if len(looks) == STILL_LOOKS:
        moved = max(moved_px(earlier, looks[-1]) for earlier in looks)
    return Reading("movement", moved, None, _STILL_PX, "px")


def moved_px(one: CornersSeen, other: CornersSeen) -> float:
    """Return the median distance of the corners that two looks have in common; infinite where these are too few."""
    common, first, second = np.intersect1d(one.numbers, other.numbers, return_indices=True)
    if len(common) < _FEWEST_COMMON:
        return _UNKNOWN_PX
    return float(np.median(np.linalg.norm(one.points_px[first] - other.points_px[second], axis=1)))


def lean(seen: CornersSeen, spec: BoardSpec, rig: RigDescription) -> Reading:
    """Return the angle between a board and the panel, as a nominal camera sees it; 0 for a board on the jig."""
    mounting, turn_deg = rig.mounting, math.inf
    corners = board_points_mm(spec)[seen.numbers]
    # Corners in a line do not tell how a board lies.
    if len(corners) >= _FEWEST_CORNERS and np.linalg.matrix_rank(corners - corners.mean(axis=0)) == 2:
        camera = np.diag([rig.focal_px, rig.focal_px, 1.0])
        camera[:2, 2] = (rig.camera.columns - 1) / 2, (rig.camera.rows - 1) / 2
        with suppress(cv2.error):
            turn = cv2.Rodrigues(cv2.solvePnP(corners, seen.points_px, camera, None)[1])[0]
            turn_deg = math.degrees(math.acos(min(abs(float((nominal_rotation(rig) @ turn)[2, 2])), 1.0)))
    most_deg = mounting.tilt_deg.tolerance + mounting.yaw_deg.tolerance + _LEAN_DEG
    return Reading("lean of the board", turn_deg, None, most_deg, "deg")


def sharpness(frame: Frame) -> Reading:
    """Return the steepest edges of a picture of black and white, per px; 0.5 for the sharpest that pixels can show."""
    picture = cv2.blur(frame.data.astype(np.float32), (2, 2))
    low, high = np.percentile(picture[::4, ::4], (2, 98))
    steep = np.abs(np.diff(picture, axis=1))
    found = float(np.percentile(steep[::4], 99.5)) / max(float(high - low), 1.0)
    return Reading("sharpness", found, 0.05, None, "1/px")


def why_not(reading: Reading) -> str:
    """Return a sentence for a reading that is out of its bounds, for those that no check of a step has one for."""
    low = reading.low is not None and reading.value < reading.low
    match reading.name:
        case "head-room" if low:
            return "The light is too bright for this exposure; a shorter one is tried. If this stays, dim the light."
        case "head-room":
            return "Little light is seen; a longer exposure is tried. If this stays, see that the light is on."
        case "movement":
            return "Hold the board still."
        case "lean of the board":
            return f"The board leans by {reading.value:.0f} degrees against the display. Lay it flat on the jig."
        case "sharpness":
            return "The picture is blurred. Hold still what is seen, and check the focus."
        case _:
            return f"Expected another {reading.name} than {reading.value:.3g} {reading.unit}".rstrip() + "."


def _picture(data: Shaped[np.ndarray, "rows columns"]) -> tuple[np.ndarray, int]:
    """Return a mosaic as a grey 8-bit picture, and how many times it is magnified."""
    grey = cv2.blur(data.astype(np.float32), (2, 2))  # every 2 x 2 holds each site of the pattern once
    low, high = np.percentile(grey, (0.5, 99.5))
    picture = np.clip((grey - low) / max(float(high - low), 1.0) * 255, 0, 255).astype(np.uint8)
    if min(picture.shape) >= _MAGNIFIED_BELOW_PX:
        return picture, 1
    return cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), 2


def _patches(frame: Frame) -> np.ndarray:
    """Return means over about 16 x 16 patches of whole 2 x 2 cells: colour and noise average out."""
    height, width = (2 * max(1, side // 32) for side in frame.data.shape)
    down, across = frame.data.shape[0] // height, frame.data.shape[1] // width
    whole = frame.data[: down * height, : across * width]
    return whole.reshape(down, height, across, width).mean(axis=(1, 3))


def _centroid(light: Float[np.ndarray, "rows columns"], column: int, row: int) -> tuple[float, float]:
    """Return (x, y) of a small light near a sample: the centroid under a Gaussian that is centred on it.

    Each site of the 2 x 2 pattern counts by its own light in the window, so that the colours draw alike.
    """
    top, left = (max(0, (at - _ABOUT_PX) // 2 * 2) for at in (row, column))
    part = light[top : row + _ABOUT_PX + 1, left : column + _ABOUT_PX + 1].copy()
    for down in (0, 1):
        for across in (0, 1):
            site = part[down::2, across::2]
            site /= max(float(site.mean()), 1e-9)
    y, x = np.mgrid[: part.shape[0], : part.shape[1]]
    place = np.array([column - left, row - top], np.float64)
    for _ in range(_CENTRING):
        near = part * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * _CORE_PX**2))
        place = np.array([np.average(x, weights=near), np.average(y, weights=near)])
    return left + float(place[0]), top + float(place[1])
