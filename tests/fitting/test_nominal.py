from __future__ import annotations

import jax
import numpy as np
import pytest

from udccal.fitting.nominal import nominal_geometry
from udccal.models.geometry import panel_directions, panel_points_mm, rotation_matrix, tilt_rad
from udccal.rig import load_rig


def test_nominal_values_are_those_of_the_rig() -> None:
    rig = load_rig("lg55-aca2040")
    geometry = nominal_geometry(rig)
    assert geometry.focal_px[0] == pytest.approx(6000 / 3.45)
    assert tuple(geometry.principal_point_px) == (1023.5, 767.5)
    np.testing.assert_allclose(geometry.pupil_mm, [960 * 0.63, 300 * 0.63, -14.0])
    with jax.enable_x64(True):
        assert np.rad2deg(float(tilt_rad(geometry))) == pytest.approx(17.0)
        matrix = np.asarray(rotation_matrix(geometry.rotation_rad))
    assert np.rad2deg(np.arctan2(matrix[1, 0], matrix[1, 1])) == pytest.approx(0.6)
    assert np.rad2deg(np.arctan2(matrix[0, 2], matrix[2, 2])) == pytest.approx(-0.4)


def test_the_camera_looks_down_through_the_panel() -> None:
    geometry = nominal_geometry(load_rig("mk31-imx1600"))
    with jax.enable_x64(True):
        ray = np.asarray(panel_directions(geometry, geometry.principal_point_px[None]))[0]
        point = np.asarray(panel_points_mm(geometry, geometry.principal_point_px[None]))[0]
    assert ray[2] > 0.9
    assert ray[1] == pytest.approx(np.sin(np.deg2rad(9.0)))
    assert point[1] > geometry.pupil_mm[1]


def test_another_tilt_gives_another_geometry() -> None:
    rig = load_rig("lg55-aca2040")
    tilted = rig.mounting.model_copy(update={"tilt_deg": rig.mounting.tilt_deg.model_copy(update={"value": 10.0})})
    other = nominal_geometry(rig.model_copy(update={"mounting": tilted}))
    assert np.abs(other.rotation_rad - nominal_geometry(rig).rotation_rad).max() > 0.1
