"""The hidden true values of a simulated rig, drawn once from its description with a seed.

This code uses numpy and is separate from ``udccal.models`` on purpose, so that agreement between the two is evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.rig import Nominal, RigDescription


@dataclass(frozen=True)
class Optics:
    """True camera geometry; see docs/conventions.md for the frames."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, float, float, float, float]
    R_panel_camera: Float[np.ndarray, "3 3"]
    pupil_mm: Float[np.ndarray, "3"]
    pupil_diameter_mm: float
    focal_mm: float
    focus_mm: float
    tilt_deg: float


@dataclass(frozen=True)
class PanelTruth:
    """True panel structure."""

    pitch_mm: float
    row_open: float
    column_open: float
    depth_mm: float
    glass_thickness_mm: float
    glass_index: float
    gamma: float
    primaries: Float[np.ndarray, "camera_channel primary"]
    leak_e_per_s: float
    reflection_e_per_s: float


@dataclass(frozen=True)
class SensorTruth:
    """True sensor, under the names of EMVA 1288 and ELD."""

    K_DN_per_e: float
    black_DN: float
    full_well_e: float
    sigma_read_e: float
    lambda_read: float
    sigma_row_DN: float
    dark_current_e_per_s: float
    PRNU1288: float
    DSNU1288_e: float
    hot_fraction: float
    bits: int
    cfa: str


@dataclass(frozen=True)
class RigTruth:
    """The true values of everything that the rig's description leaves open."""

    description: RigDescription
    seed: int
    optics: Optics
    panel: PanelTruth
    sensor: SensorTruth


def rotation_matrix(axis: int, angle_rad: float) -> Float[np.ndarray, "3 3"]:
    """Return the right-handed rotation about a coordinate axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def draw_truth(description: RigDescription, seed: int = 0, at_ends: bool = False) -> RigTruth:
    """Draw the true values of a rig.

    Args:
        description: the rig description; each nominal value is moved by up to 0.8 of its tolerance.
        seed: seed of all draws, including values that no data sheet gives.
        at_ends: move each nominal value by its whole tolerance instead, up or down.
    """
    rng = np.random.default_rng([seed, 0x7AB1E])

    def drawn(nominal: Nominal) -> float:
        part = float(rng.uniform(-0.8, 0.8))
        return nominal.value + nominal.tolerance * (float(np.sign(part)) if at_ends else part)

    optics = _draw_optics(description, drawn, rng)
    mix = np.array([[1.0, 0.09, 0.02], [0.12, 1.0, 0.10], [0.03, 0.14, 1.0]])
    panel = PanelTruth(
        pitch_mm=drawn(description.panel.pitch_mm),
        row_open=drawn(description.panel.row_open),
        column_open=drawn(description.panel.column_open),
        depth_mm=drawn(description.panel.depth_mm),
        glass_thickness_mm=description.panel.glass_thickness_mm,
        glass_index=description.panel.glass_index,
        gamma=drawn(description.panel.gamma),
        primaries=mix * rng.uniform(0.8, 1.2, (3, 3)) * np.array([0.7, 1.0, 0.6])[:, None],
        leak_e_per_s=4.0e4 * float(rng.uniform(0.9, 1.1)),
        reflection_e_per_s=6.0e4 * float(rng.uniform(0.9, 1.1)),
    )
    camera = description.camera
    sensor = SensorTruth(
        K_DN_per_e=drawn(camera.K_DN_per_e),
        black_DN=drawn(camera.black_DN),
        full_well_e=drawn(camera.full_well_e),
        sigma_read_e=float(rng.uniform(3.5, 6.0)),
        lambda_read=float(rng.uniform(0.05, 0.12)),
        sigma_row_DN=float(rng.uniform(0.2, 0.4)) * camera.K_DN_per_e.value * 2.0,
        dark_current_e_per_s=float(rng.uniform(5.0, 30.0)),
        PRNU1288=float(rng.uniform(0.004, 0.007)),
        DSNU1288_e=float(rng.uniform(1.0, 3.0)),
        hot_fraction=2e-5,
        bits=camera.bits,
        cfa=camera.cfa,
    )
    return RigTruth(description=description, seed=seed, optics=optics, panel=panel, sensor=sensor)


def _draw_optics(description: RigDescription, drawn, rng: np.random.Generator) -> Optics:  # type: ignore[no-untyped-def]
    camera, mounting = description.camera, description.mounting
    focal_mm = drawn(description.lens.focal_mm)
    fx = focal_mm * 1000.0 / camera.pitch_um
    tilt, roll, yaw = (np.deg2rad(drawn(n)) for n in (mounting.tilt_deg, mounting.roll_deg, mounting.yaw_deg))
    rotation = rotation_matrix(1, yaw) @ rotation_matrix(0, -tilt) @ rotation_matrix(2, roll)
    pitch = description.panel.pitch_mm.value
    pupil = np.array(
        [drawn(mounting.panel_x_px) * pitch, drawn(mounting.panel_y_px) * pitch, -drawn(mounting.standoff_mm)]
    )
    return Optics(
        fx_px=fx,
        fy_px=fx * (1 + float(rng.normal(0, 2e-4))),
        cx_px=(camera.columns - 1) / 2 + float(rng.uniform(-0.006, 0.006)) * camera.columns,
        cy_px=(camera.rows - 1) / 2 + float(rng.uniform(-0.006, 0.006)) * camera.rows,
        distortion=(
            float(rng.uniform(-0.09, -0.05)),
            float(rng.uniform(0.02, 0.05)),
            float(rng.uniform(-4e-4, 4e-4)),
            float(rng.uniform(-4e-4, 4e-4)),
            float(rng.uniform(-0.01, 0.0)),
        ),
        R_panel_camera=rotation,
        pupil_mm=pupil,
        pupil_diameter_mm=focal_mm / drawn(description.lens.f_number),
        focal_mm=focal_mm,
        focus_mm=description.lens.focus_mm,
        tilt_deg=float(np.rad2deg(np.arcsin(rotation[1, 2]))),
    )


def distort(optics: Optics, ideal: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Distort ideal normalised image points (Brown-Conrady, five coefficients in OpenCV's order)."""
    k1, k2, p1, p2, k3 = optics.distortion
    x, y = ideal[..., 0], ideal[..., 1]
    r2 = x**2 + y**2
    gain = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    dx = 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    dy = p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([x * gain + dx, y * gain + dy], axis=-1)


def directions_to_pixels(optics: Optics, directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Project directions in panel coordinates to sensor pixels."""
    rays = directions @ optics.R_panel_camera
    bent = distort(optics, rays[..., :2] / rays[..., 2:])
    return bent * np.array([optics.fx_px, optics.fy_px]) + np.array([optics.cx_px, optics.cy_px])


def pixels_to_directions(optics: Optics, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
    """Return the rays through sensor pixels, by fixed-point inversion of the distortion to 1e-10.

    Args:
        optics: true camera geometry.
        pixels: (x, y) in sensor pixels.

    Returns:
        unit vectors in panel coordinates.
    """
    seen = (pixels - np.array([optics.cx_px, optics.cy_px])) / np.array([optics.fx_px, optics.fy_px])
    ideal = seen.copy()
    for _ in range(40):
        missing = seen - distort(optics, ideal)
        ideal += missing
        if np.abs(missing).max(initial=0.0) < 1e-14:
            break
    rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1) @ optics.R_panel_camera.T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
