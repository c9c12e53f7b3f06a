from __future__ import annotations

from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udccal.compilation import compilation_clock
from udccal.models import geometry as g
from udccal.numerics import in_float64

GEOMETRY = g.Geometry(
    focal_px=np.array([1740.0, 1741.0]),
    principal_point_px=np.array([1020.0, 770.0]),
    distortion=np.array([-0.07, 0.03, 3e-4, -2e-4, -0.006]),
    rotation_rad=np.array([-0.3, 0.02, 0.01]),
    pupil_mm=np.array([600.0, 190.0, -14.0]),
)


def pixels() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, 2047, 9), np.linspace(0, 1535, 7))
    return np.stack([x.ravel(), y.ravel()], axis=1)


@in_float64
def projected(geometry: g.Geometry, points: np.ndarray) -> np.ndarray:
    return np.asarray(g.project(geometry, points))


def opencv(points: np.ndarray) -> np.ndarray:
    fx, fy = GEOMETRY.focal_px
    cx, cy = GEOMETRY.principal_point_px
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, GEOMETRY.distortion)
    return seen.reshape(-1, 2)


def test_projection_is_that_of_opencv() -> None:
    points = np.random.default_rng(0).uniform([-500, -400, 900], [500, 400, 1500], (50, 3))
    np.testing.assert_allclose(projected(GEOMETRY, points), opencv(points), atol=1e-8)


def test_exchanged_tangential_terms_do_not_pass_for_opencv() -> None:
    k1, k2, p1, p2, k3 = GEOMETRY.distortion
    wrong = g.Geometry(
        GEOMETRY.focal_px,
        GEOMETRY.principal_point_px,
        np.array([k1, k2, p2, p1, k3]),
        GEOMETRY.rotation_rad,
        GEOMETRY.pupil_mm,
    )
    points = np.random.default_rng(0).uniform([-500, -400, 900], [500, 400, 1500], (50, 3))
    assert np.abs(projected(wrong, points) - opencv(points)).max() > 0.05


def test_directions_come_back_to_their_pixels() -> None:
    with jax.enable_x64(True):
        directions = g.panel_directions(GEOMETRY, pixels())
        back = np.asarray(g.project_directions(GEOMETRY, directions))
    np.testing.assert_allclose(back, pixels(), atol=1e-6)


@pytest.mark.medium
def test_area_of_pixels_is_the_determinant_of_the_directions_slopes() -> None:
    def cosines(pixel: jax.Array) -> jax.Array:
        return g.panel_directions(GEOMETRY, pixel[None])[0, :2]

    @in_float64
    def both() -> tuple[np.ndarray, np.ndarray]:
        slopes = jax.vmap(jax.jacfwd(cosines))(jnp.asarray(pixels()))
        return np.asarray(g.area_of_pixels(GEOMETRY, pixels())), np.abs(np.linalg.det(np.asarray(slopes)))

    area, determinant = both()
    np.testing.assert_allclose(area, determinant, rtol=1e-9)
    assert np.ptp(area) > 0.2 * area.mean()


@pytest.mark.medium
def test_rotation_is_that_of_opencv_and_has_a_derivative_at_zero() -> None:
    vector = np.array([0.3, -0.2, 0.5])
    with jax.enable_x64(True):
        ours = np.asarray(g.rotation_matrix(vector))
        slope = np.asarray(jax.jacfwd(g.rotation_matrix)(jnp.zeros(3)))
    np.testing.assert_allclose(ours, cv2.Rodrigues(vector)[0], atol=1e-12)
    assert slope[2, 1, 0] == 1.0
    assert slope[1, 2, 0] == -1.0


def test_tilt_is_positive_when_the_camera_looks_down() -> None:
    with jax.enable_x64(True):
        rotation = np.asarray(g.mounting_rotation(np.float64(0.3), np.float64(0.02), np.float64(-0.01)))
    axis = rotation @ [0.0, 0.0, 1.0]
    assert axis[1] > 0
    assert np.arcsin(axis[1]) == pytest.approx(0.3, abs=1e-12)


def test_a_ray_meets_the_panel_in_front_of_the_pupil() -> None:
    with jax.enable_x64(True):
        point = np.asarray(g.panel_points_mm(GEOMETRY, pixels()))
        rays = np.asarray(g.panel_directions(GEOMETRY, pixels()))
    distance = 14.0 / rays[:, 2]
    np.testing.assert_allclose(point, GEOMETRY.pupil_mm[:2] + rays[:, :2] * distance[:, None], atol=1e-9)


def test_without_distortion_the_virtual_view_is_a_homography() -> None:
    plain = g.Geometry(
        GEOMETRY.focal_px, GEOMETRY.principal_point_px, np.zeros(5), GEOMETRY.rotation_rad, GEOMETRY.pupil_mm
    )
    view = g.VirtualView(columns=1920, rows=1080, focal_px=1700.0, principal_point_px=np.array([950.0, 100.0]))
    points = np.array([[10.0, 20.0], [1900.0, 30.0], [700.0, 1000.0]])
    with jax.enable_x64(True):
        sensor = np.asarray(g.view_to_sensor(plain, view, points))
        matrix = np.asarray(g.virtual_rotation_homography(plain, view))
    back = np.concatenate([sensor, np.ones((3, 1))], axis=1) @ matrix.T
    np.testing.assert_allclose(back[:, :2] / back[:, 2:], points, atol=1e-7)


def test_rays_of_another_lens_compile_nothing_anew() -> None:
    """A program that asks for rays again and again would wait for a compilation each time, and fill its memory."""
    clock = compilation_clock()
    with jax.enable_x64(True):
        g.unproject(GEOMETRY, pixels())
        before = clock.seconds
        other = replace(GEOMETRY, distortion=GEOMETRY.distortion + 1e-4)
        np.asarray(g.unproject(other, pixels()))
    assert clock.seconds == before
