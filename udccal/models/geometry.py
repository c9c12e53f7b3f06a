"""Geometry: pinhole with Brown-Conrady distortion, the pose of the camera behind the panel, and the virtual rotation.

docs/conventions.md defines pixel coordinates, frames and signs. All functions are pure and differentiable.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from udccal.models.arrays import Arrayish


class Geometry(eqx.Module):
    """Intrinsics, distortion and pose of the camera, which give the ray of every pixel.

    Attributes:
        focal_px: (fx, fy). principal_point_px: (cx, cy).
        distortion: (k1, k2, p1, p2, k3), OpenCV's order and signs.
        rotation_rad: rotation vector in rad of ``R_panel_camera`` (camera coordinates to panel coordinates).
        pupil_mm: entrance pupil in panel coordinates in mm; z is minus the stand-off.
    """

    focal_px: Float[Arrayish, "2"]
    principal_point_px: Float[Arrayish, "2"]
    distortion: Float[Arrayish, "5"]
    rotation_rad: Float[Arrayish, "3"]
    pupil_mm: Float[Arrayish, "3"]


class VirtualView(eqx.Module):
    """A distortion-free pinhole picture whose image plane is parallel to the panel, seen from the same pupil."""

    columns: int = eqx.field(static=True)
    rows: int = eqx.field(static=True)
    focal_px: float
    principal_point_px: Float[Arrayish, "2"]


def rotation_matrix(vector: Float[Arrayish, "3"]) -> Float[Array, "3 3"]:
    """Return the rotation matrix of a rotation vector in rad by Rodrigues' formula, differentiable at zero."""
    x, y, z = jnp.asarray(vector)
    angle2 = x * x + y * y + z * z
    small = angle2 < 1e-12
    safe = jnp.where(small, 1.0, angle2)
    angle = jnp.sqrt(safe)
    s = jnp.where(small, 1.0 - angle2 / 6.0, jnp.sin(angle) / angle)
    c = jnp.where(small, 0.5 - angle2 / 24.0, (1.0 - jnp.cos(angle)) / safe)
    zero = jnp.zeros_like(x)
    k = jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    return jnp.eye(3, dtype=k.dtype) + s * k + c * (k @ k)


def mounting_rotation(
    tilt_rad: Float[Arrayish, ""], roll_rad: Float[Arrayish, ""], yaw_rad: Float[Arrayish, ""]
) -> Float[Array, "3 3"]:
    """Return ``R_panel_camera`` = Ry(yaw) Rx(-tilt) Rz(roll)."""
    zero = jnp.zeros_like(jnp.asarray(tilt_rad, dtype=float))
    ry = rotation_matrix(jnp.stack([zero, jnp.asarray(yaw_rad), zero]))
    rx = rotation_matrix(jnp.stack([-jnp.asarray(tilt_rad), zero, zero]))
    rz = rotation_matrix(jnp.stack([zero, zero, jnp.asarray(roll_rad)]))
    return ry @ rx @ rz


def tilt_rad(geometry: Geometry) -> Float[Array, ""]:
    """Return the angle in rad by which the axis of a camera of this ``geometry`` points below the panel's normal."""
    axis = rotation_matrix(geometry.rotation_rad)[:, 2]
    return jnp.arcsin(jnp.clip(axis[1], -1.0, 1.0))


def distort(geometry: Geometry, points: Float[Arrayish, "*n 2"]) -> Float[Array, "*n 2"]:
    """Distort ideal normalised image points (Brown-Conrady, OpenCV's five coefficients)."""
    points = jnp.asarray(points)
    k1, k2, p1, p2, k3 = jnp.asarray(geometry.distortion)
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return jnp.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def stretch(geometry: Geometry, points: Float[Arrayish, "*n 2"]) -> Float[Array, "*n"]:
    """Return the area after ``distort`` over the area before it: the determinant of its Jacobian at ideal points."""
    points = jnp.asarray(points)
    k1, k2, p1, p2, k3 = jnp.asarray(geometry.distortion)
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # d(radial)/dx = 2 x slope and d(radial)/dy = 2 y slope.
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
    x_by_x = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    y_by_y = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    crossed = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    return x_by_x * y_by_y - crossed * crossed


def project(geometry: Geometry, points: Float[Arrayish, "*n 3"]) -> Float[Array, "*n 2"]:
    """Project points onto the sensor.

    Args:
        geometry: camera geometry.
        points: (x, y, z) in camera coordinates, in any unit, z > 0.

    Returns:
        (x, y) in sensor pixels.
    """
    points = jnp.asarray(points)
    ideal = points[..., :2] / points[..., 2:]
    return distort(geometry, ideal) * jnp.asarray(geometry.focal_px) + jnp.asarray(geometry.principal_point_px)


# Compiled once per shape. A loop outside of compiled code is compiled at every call, and its memory is never freed.
@partial(jax.jit, static_argnames="iterations", inline=True)
def unproject(geometry: Geometry, pixels: Float[Arrayish, "*n 2"], iterations: int = 12) -> Float[Array, "*n 2"]:
    """Undo distortion and intrinsics by fixed-point iteration.

    Args:
        geometry: camera geometry.
        pixels: (x, y) in sensor pixels.
        iterations: rounds; 12 leave less than 1e-9 px for distortions up to 10 %.

    Returns:
        ideal normalised image points (x/z, y/z).
    """
    measured = (jnp.asarray(pixels) - jnp.asarray(geometry.principal_point_px)) / jnp.asarray(geometry.focal_px)

    # A compiled loop: unrolled, it would take most of the compilation time of a fit.
    def closer(_: Int[Array, ""], ideal: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        return ideal + measured - distort(geometry, ideal)

    return jax.lax.fori_loop(0, iterations, closer, measured)


def panel_directions(geometry: Geometry, pixels: Float[Arrayish, "*n 2"]) -> Float[Array, "*n 3"]:
    """Return the rays through sensor pixels.

    Args:
        geometry: camera geometry.
        pixels: (x, y) in sensor pixels.

    Returns:
        unit vectors in panel coordinates that point to the viewer's side.
    """
    ideal = unproject(geometry, pixels)
    rays = jnp.concatenate([ideal, jnp.ones_like(ideal[..., :1])], axis=-1)
    rays = rays @ rotation_matrix(geometry.rotation_rad).T
    return rays / jnp.linalg.norm(rays, axis=-1, keepdims=True)


def area_of_pixels(geometry: Geometry, pixels: Float[Arrayish, "*n 2"]) -> Float[Array, "*n"]:
    """Return the area in panel direction cosines (l_x, l_y) that a square pixel covers at each of ``pixels``.

    An ideal image point at radius r sees the solid angle (1 + r^2)^(-3/2) per unit area. Projection onto the plane of
    the cosines multiplies it by l_z.
    """
    ideal = unproject(geometry, pixels)
    rays = jnp.concatenate([ideal, jnp.ones_like(ideal[..., :1])], axis=-1)
    length = jnp.linalg.norm(rays, axis=-1)
    along = jnp.abs(rays @ rotation_matrix(geometry.rotation_rad)[2]) / length
    return along / (length**3 * jnp.abs(stretch(geometry, ideal)) * jnp.prod(jnp.asarray(geometry.focal_px)))


def panel_points_mm(geometry: Geometry, pixels: Float[Arrayish, "*n 2"]) -> Float[Array, "*n 2"]:
    """Return the points at which the rays through sensor pixels cross the panel plane.

    Args:
        geometry: camera geometry.
        pixels: (x, y) in sensor pixels.

    Returns:
        (x, y) in panel coordinates in mm.
    """
    rays = panel_directions(geometry, pixels)
    pupil = jnp.asarray(geometry.pupil_mm)
    return pupil[:2] - pupil[2] * rays[..., :2] / rays[..., 2:]


def project_directions(geometry: Geometry, directions: Float[Arrayish, "*n 3"]) -> Float[Array, "*n 2"]:
    """Project directions onto the sensor; the inverse of ``panel_directions``.

    Args:
        geometry: camera geometry.
        directions: vectors of any length in panel coordinates.

    Returns:
        (x, y) in sensor pixels.
    """
    return project(geometry, jnp.asarray(directions) @ rotation_matrix(geometry.rotation_rad))


def view_to_sensor(geometry: Geometry, view: VirtualView, view_pixels: Float[Arrayish, "*n 2"]) -> Float[Array, "*n 2"]:
    """Return the sensor pixel that each pixel of a virtual view looks at: virtual rotation and distortion in one map.

    Args:
        geometry: camera geometry.
        view: the virtual view.
        view_pixels: (x, y) in pixels of the view.

    Returns:
        (x, y) in sensor pixels.
    """
    plane = (jnp.asarray(view_pixels) - jnp.asarray(view.principal_point_px)) / view.focal_px
    directions = jnp.concatenate([plane, jnp.ones_like(plane[..., :1])], axis=-1)
    return project_directions(geometry, directions)


def virtual_rotation_homography(geometry: Geometry, view: VirtualView) -> Float[Array, "3 3"]:
    """Return the homography from undistorted sensor pixels to pixels of a view: K_view R_panel_camera K^-1."""
    fx, fy = jnp.asarray(geometry.focal_px)
    cx, cy = jnp.asarray(geometry.principal_point_px)
    vx, vy = jnp.asarray(view.principal_point_px)
    one, zero = jnp.ones_like(fx), jnp.zeros_like(fx)
    inverse = jnp.array([[one / fx, zero, -cx / fx], [zero, one / fy, -cy / fy], [zero, zero, one]])
    outer = jnp.array([[view.focal_px, 0.0, vx], [0.0, view.focal_px, vy], [0.0, 0.0, 1.0]])
    return outer @ rotation_matrix(geometry.rotation_rad) @ inverse
