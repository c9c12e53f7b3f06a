"""What terms share: errors of one that a fit of another carries on, against fits of data whose errors are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.comparison.perturbed import with_result
from tests.scenes.backscatter import RULES, panel_pictures, shots_of, small_rig, world
from tests.scenes.psf import pictures, small_scene
from tests.scenes.psf import shots_of as led_shots
from udccal.comparison.held import held_estimates
from udccal.comparison.shared import _made_up
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.geometry.fit import term_at
from udccal.fitting.psf.data import PsfData, PsfRules
from udccal.fitting.psf.fit import fit_psf
from udccal.fitting.psf.start import pack, start_model
from udccal.models.geometry import unproject
from udccal.mounting import angles_deg
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile


@in_float64
def test_the_wires_pose_makes_up_for_an_error_of_the_lens(measured: Profile) -> None:
    """Against a fit of the pose to phases seen through another lens, at other places than the code's."""
    held = held_estimates(measured)
    number = {name: float(value) for name, value in zip(held.names, held.values, strict=True)}
    of = measured.wire.term.geometry
    lens = np.array([number["geometry", name] for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")])
    names = ("tilt_deg", "roll_deg", "yaw_deg", "standoff_per_pitch", "offset_x_periods", "offset_y_periods")
    pose = np.array([number["wire", name] for name in names])
    pixels = np.stack(np.meshgrid(np.arange(13, 1024, 26.0), np.arange(12, 768, 24.0)), axis=-1).reshape(-1, 2)

    def phases(lens: np.ndarray, pose: np.ndarray) -> np.ndarray:
        term = term_at(np.concatenate([lens, pose[:3]]), np.zeros(3))
        rays = np.column_stack([np.asarray(unproject(term, pixels)), np.ones(len(pixels))])
        rays = rays @ Rotation.from_rotvec(term.rotation_rad).as_matrix().T
        return (pose[3] * rays[:, :2] / rays[:, 2:] + pose[4:]).ravel()

    for off in (np.eye(9)[0] * 0.5 + np.eye(9)[1] * 0.5, np.eye(9)[2] * 0.5 - np.eye(9)[3] * 0.3):
        seen = phases(lens + off, pose)
        fit = least_squares(
            lambda p, seen=seen: phases(lens, p) - seen, pose, x_scale=[0.1] * 3 + [0.01] * 3, xtol=1e-14
        )
        # The data are of the lens with ``off``; a fit that holds the other lens is off by minus that.
        expected = _made_up(measured.rig, of, pose, 6)[:, :9] @ -off
        np.testing.assert_allclose(fit.x - pose, expected, rtol=0.1, atol=2e-4)


@pytest.mark.parametrize("off", [np.eye(12)[0] * 0.5 + np.eye(12)[1] * 0.5, np.eye(12)[9] * 0.2, np.eye(12)[11] * -0.2])
@pytest.mark.medium
def test_backscatter_makes_up_for_an_error_of_lens_or_rotation(off: np.ndarray) -> None:
    """Against its fit of the same light, with another geometry held."""
    rng, rig = np.random.default_rng(4), small_rig()
    of = world(rng, rig)
    data, geometry = shots_of(of, rng, panel_pictures(rig, 0, 8)), of.term.geometry
    turn_deg = angles_deg(np.asarray(geometry.rotation_rad))
    lens = np.concatenate([geometry.focal_px, geometry.principal_point_px, geometry.distortion, turn_deg])
    other = term_at(lens + off, np.asarray(geometry.pupil_mm))
    names = ("standoff_mm", "offset_x_px", "offset_y_px")
    one, changed = (fit_backscatter(data, held, rig, RULES) for held in (geometry, other))
    found = np.array([changed.estimate(name).value - one.estimate(name).value for name in names])
    pitch, at = rig.panel.pitch_mm.value, np.array([one.estimate(name).value for name in names])
    by_held = _made_up(rig, geometry, np.concatenate([turn_deg, at / [pitch, -1, -1]]), 3)
    expected = np.array([pitch, -1, -1]) * (by_held @ off)
    assert np.abs(expected).max() > 0.05
    np.testing.assert_allclose(found, expected, atol=0.1 * np.abs(expected).max())


def test_their_errors_are_in_the_covariance_of_all_terms(measured: Profile) -> None:
    held, own = held_estimates(measured), measured.backscatter
    names = ["standoff_mm", "offset_x_px", "offset_y_px"]
    at = [held.names.index(("backscatter", name)) for name in names]
    geometry, pitch = own.term.geometry, measured.rig.panel.pitch_mm.value
    turn_deg = angles_deg(np.asarray(geometry.rotation_rad))
    pose = np.concatenate([turn_deg, [float(own.term.standoff_mm) / pitch, 0.0, 0.0]])
    by_held = np.diag([pitch, -1, -1]) @ _made_up(measured.rig, geometry, pose, 3)
    share = by_held @ measured.geometry.cov
    at_held = [held.names.index(("geometry", one.name)) for one in measured.geometry.estimates]
    np.testing.assert_allclose(held.cov[np.ix_(at, at_held)], share, rtol=1e-3, atol=1e-3 * np.abs(share).max())
    alone = own.cov[np.ix_(*[[[one.name for one in own.estimates].index(name) for name in names]] * 2)]
    np.testing.assert_allclose(held.cov[np.ix_(at, at)], alone + share @ by_held.T, rtol=1e-6)
    # Without the geometry's covariance nothing is shared.
    alone = held_estimates(with_result(measured, "geometry", cov=np.zeros((0, 0))))
    at = [alone.names.index(("backscatter", name)) for name in names]
    np.testing.assert_allclose(np.sqrt(np.diag(alone.cov))[at], [own.estimate(name).sigma for name in names])


@pytest.mark.medium
def test_the_psf_does_not_follow_an_error_of_the_wire() -> None:
    """The wire's openings and depth are means of its priors: ten sigma of them are less than a tenth of its own."""
    rng, scene = np.random.default_rng(5), small_scene()
    theta = pack(start_model(scene.rig, scene.geometry, scene.wire))
    data = PsfData(led_shots(scene, pictures(scene, theta, rng), rng))
    off = replace(scene.wire, row_open=scene.wire.row_open + 0.002, depth_per_pitch=scene.wire.depth_per_pitch + 0.002)
    rules = PsfRules(positions=6, shifts=2, half_px=scene.half, close_px=(12, 6), iterations=25)
    one, changed = (fit_psf(data, scene.rig, scene.geometry, wire, rules) for wire in (scene.wire, off))
    for name in ("row_open", "column_open", "depth_mm", "pupil_diameter_mm"):
        found, other = one.estimate(name), changed.estimate(name)
        assert other.prior != found.prior or name in ("column_open", "pupil_diameter_mm")
        assert abs(other.value - found.value) < 0.1 * found.sigma, name
