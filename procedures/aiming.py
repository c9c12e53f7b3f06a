"""Computes where to hold things from the nominal mounting: numbers for a person, which no fit ever reads."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.arrangements import Board, BoardSpec
from udccal.mounting import nominal_pupil_mm, nominal_rotation
from udccal.rig import RigDescription

_PLASTIC = 1.32471795724474602596  # root of x^3 = x + 1


def low_discrepancy(count: int, dimensions: int = 2) -> Float[np.ndarray, "count dimensions"]:
    """Return points that fill the unit cube evenly at any count: the R-sequence.

    Source: M. Roberts, The unreasonable effectiveness of quasirandom sequences (2018).
    """
    growth = _PLASTIC if dimensions == 2 else _generalised_golden_ratio(dimensions)
    steps = growth ** -np.arange(1.0, dimensions + 1)
    return (0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0


def nominal_ray(rig: RigDescription, x_px: float, y_px: float) -> Float[np.ndarray, "3"]:
    """Return the viewing direction of a sensor pixel in panel coordinates, of length 1 along the camera's axis."""
    camera = rig.camera
    across = (x_px - (camera.columns - 1) / 2) / rig.focal_px
    down = (y_px - (camera.rows - 1) / 2) / rig.focal_px
    return nominal_rotation(rig) @ np.array([across, down, 1.0])


def nominal_pixels(rig: RigDescription, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Return the sensor pixels at which a perfect nominal camera sees points in panel coordinates (mm)."""
    rays = (points_mm - nominal_pupil_mm(rig)) @ nominal_rotation(rig)
    centre = np.array([(rig.camera.columns - 1) / 2, (rig.camera.rows - 1) / 2])
    return rays[:, :2] / rays[:, 2:] * rig.focal_px + centre


def board_facing(
    rig: RigDescription,
    spec: BoardSpec,
    pixel: tuple[float, float],
    distance_mm: float,
    lean_rad: tuple[float, float, float],
) -> Board:
    """Return a board whose centre is seen at ``pixel``, rotated about x, y, then z from facing the camera."""
    lean = Rotation.from_euler("xyz", lean_rad).as_matrix()
    return _placed(rig, spec, pixel, distance_mm, nominal_rotation(rig) @ lean, parallel=False)


def board_parallel(rig: RigDescription, spec: BoardSpec, distance_mm: float) -> Board:
    """Return a board parallel to the panel whose centre is seen in the middle of the sensor."""
    middle = ((rig.camera.columns - 1) / 2, (rig.camera.rows - 1) / 2)
    return _placed(rig, spec, middle, distance_mm, np.eye(3), parallel=True)


def _placed(
    rig: RigDescription,
    spec: BoardSpec,
    pixel: tuple[float, float],
    distance_mm: float,
    rotation: Float[np.ndarray, "3 3"],
    parallel: bool,
) -> Board:
    centre = nominal_pupil_mm(rig) + distance_mm * nominal_ray(rig, *pixel)
    half = np.array([spec.columns, spec.rows, 0.0]) * spec.square_mm / 2
    x, y, z = (float(value) for value in centre - rotation @ half)
    along_x, along_y, along_z = (float(value) for value in Rotation.from_matrix(rotation).as_rotvec())
    return Board(spec, (along_x, along_y, along_z), (x, y, z), parallel_to_panel=parallel)


def _generalised_golden_ratio(dimensions: int) -> float:
    ratio = 2.0
    for _ in range(60):
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    return ratio
