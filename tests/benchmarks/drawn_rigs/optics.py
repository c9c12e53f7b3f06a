"""Rays of a drawn rig: pixels to directions in the panel's frame, and the pupil's footprint on planes of the panel."""

from __future__ import annotations

import numpy as np

from tests.benchmarks.drawn_rigs.draw import Rig

CFA_LETTERS = "RGB"


def rotation(rig: Rig) -> np.ndarray:
    """R_panel_camera = Ry(yaw) Rx(-tilt) Rz(roll)."""
    tilt, roll, yaw = (np.deg2rad(rig.true(name)) for name in ("tilt_deg", "roll_deg", "yaw_deg"))

    def turn(axis: int, angle: float) -> np.ndarray:
        (c, s), (i, j) = (np.cos(angle), np.sin(angle)), ((axis + 1) % 3, (axis + 2) % 3)
        matrix = np.eye(3)
        matrix[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
        return matrix

    return turn(1, yaw) @ turn(0, -tilt) @ turn(2, roll)


def tilt_deg(rig: Rig) -> float:
    """How far the camera's axis looks down."""
    return float(np.rad2deg(np.arcsin(rotation(rig)[1, 2])))


def directions(rig: Rig, pixels: np.ndarray) -> np.ndarray:
    """Unit vectors, in the panel's frame, of the rays through pixels (x, y); the distortion is undone by iteration."""
    k1, k2, p1, p2 = rig.lens.distortion
    seen = (pixels - rig.lens.centre_px) / rig.lens.focal_px
    ideal = seen.copy()
    for _ in range(30):
        x, y = ideal[..., 0], ideal[..., 1]
        r2 = x * x + y * y
        gain = 1 + k1 * r2 + k2 * r2 * r2
        aside = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1)
        ideal = (seen - aside) / gain[..., None]
    rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1) @ rotation(rig).T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def footprint(rig: Rig, rays: np.ndarray, plane_mm: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Centre and shape, in mm on the plane z = ``plane_mm``, of the beam that a pixel receives: centre + shape @ u."""
    slope = rays[..., :2] / rays[..., 2:]
    place = rig.pupil_place_mm
    distance = plane_mm - place[2]
    across = rotation(rig)[:, :2] * (rig.lens.pupil_mm / 2)
    shape = across[:2] - slope[..., :, None] * across[2]
    return place[:2] + distance * slope, shape * (1 - distance / rig.lens.focus_mm)


def sensor_pixels(rig: Rig) -> np.ndarray:
    """(x, y) of every sample, rows x columns x 2."""
    return np.stack(np.meshgrid(np.arange(rig.columns), np.arange(rig.rows)), axis=-1).astype(float)


def mosaic(rig: Rig, colours: np.ndarray, first: tuple[int, int] = (0, 0)) -> np.ndarray:
    """The samples of a Bayer mosaic that begins at the sensor's sample ``first`` (x, y); rows x columns x 3 in."""
    cell = np.array([CFA_LETTERS.index(letter) for letter in rig.cfa]).reshape(2, 2)
    rows, columns = colours.shape[:2]
    y, x = np.mgrid[first[1] : first[1] + rows, first[0] : first[0] + columns]
    return np.take_along_axis(colours, cell[y % 2, x % 2][..., None], axis=-1)[..., 0]
