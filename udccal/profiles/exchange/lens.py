"""The lens as other programs hold it: a pinhole with OpenCV's coefficients, and where known the camera's pose.

Pixels are those of docs/conventions.md: (0, 0) is the centre of the top-left pixel. OpenCV, ROS and mrcal agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.errors import ProfileError
from udccal.profiles.profile import Profile

COEFFICIENTS = 5
# OpenCV's model has one of these numbers of coefficients; udccal's has the first five: k1, k2, p1, p2, k3.
_COUNTS = (0, 4, 5, 8, 12, 14)
_MOST_PIXELS = 16384


@final
@dataclass(frozen=True)
class Pose:
    """Where the camera is: ``x_panel = R_panel_camera x_camera + pupil_mm``."""

    R_panel_camera: Float[np.ndarray, "3 3"]
    pupil_mm: Float[np.ndarray, "3"]


@final
@dataclass(frozen=True)
class Lens:
    """A camera's picture.

    Attributes:
        columns, rows: size of the picture in px.
        focal_px, principal_point_px: (x, y).
        distortion: (k1, k2, p1, p2, k3), OpenCV's order and signs.
        pose: None where it is not known in the panel's frame.
    """

    columns: int
    rows: int
    focal_px: Float[np.ndarray, "2"]
    principal_point_px: Float[np.ndarray, "2"]
    distortion: Float[np.ndarray, "5"]
    pose: Pose | None = None

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The camera matrix."""
        (fx, fy), (cx, cy) = self.focal_px, self.principal_point_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def lens_of(profile: Profile) -> Lens:
    """Return the lens of a profile, with its pose."""
    camera, term = profile.rig.camera, profile.geometry.term
    rotation = Rotation.from_rotvec(np.asarray(term.rotation_rad, dtype=np.float64)).as_matrix()
    return Lens(
        columns=camera.columns,
        rows=camera.rows,
        focal_px=np.asarray(term.focal_px, dtype=np.float64),
        principal_point_px=np.asarray(term.principal_point_px, dtype=np.float64),
        distortion=np.asarray(term.distortion, dtype=np.float64),
        pose=Pose(np.asarray(rotation), np.asarray(term.pupil_mm, dtype=np.float64)),
    )


def lens_with(
    where: str, size: tuple[int, int], pinhole: Sequence[float], coefficients: Sequence[float], pose: Pose | None = None
) -> Lens:
    """Return a lens that was read.

    Args:
        where: the file, for the message.
        size: (columns, rows).
        pinhole: (fx, fy, cx, cy) in px.
        coefficients: of the distortion, in OpenCV's order.
        pose: of the camera.

    Raises:
        ProfileError: when the size cannot be a sensor's, the coefficients are not as many as OpenCV's model has, or one
            that udccal's model lacks is not 0.
    """
    if not all(1 <= side <= _MOST_PIXELS for side in size):
        raise ProfileError(
            f"Expected a picture of 1 to {_MOST_PIXELS} px a side in {where}, found {size[0]} x {size[1]}. Check the "
            "file."
        )
    further = [value for value in coefficients[COEFFICIENTS:] if value != 0]
    if further:
        raise ProfileError(
            f"Expected no distortion beyond k1, k2, p1, p2, k3 in {where}, found {len(coefficients)} coefficients "
            "of which further ones are not 0. Calibrate with five."
        )
    if len(coefficients) not in _COUNTS:
        raise ProfileError(
            f"Expected {', '.join(map(str, _COUNTS))} coefficients in {where}, as OpenCV's model has, found "
            f"{len(coefficients)}. Calibrate with five."
        )
    held = np.zeros(COEFFICIENTS)
    held[: len(coefficients)] = coefficients[:COEFFICIENTS]
    return Lens(*size, np.array(pinhole[:2]), np.array(pinhole[2:]), held, pose)


def pinhole_of(where: str, matrix: Float[np.ndarray, "3 3"]) -> tuple[float, float, float, float]:
    """Return (fx, fy, cx, cy) of a camera matrix.

    Raises:
        ProfileError: when it has a skew, or is no camera matrix.
    """
    rest = matrix - np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
    if rest.any():
        raise ProfileError(
            f"Expected a camera matrix [fx 0 cx; 0 fy cy; 0 0 1] in {where}, found other numbers in place of its 0 and "
            "1. udccal's lens has no skew."
        )
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
