"""Comparison with the simulated truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from udccal.models.geometry import panel_directions
from udccal.numerics import in_float64
from udccal.profiles.store import load_profile
from udccal.reports.true_values import TrueValue, true_geometry, true_values
from udccal.reports.truth import TruthRow, ray_error_px, truth_table
from udccal.rig import load_rig
from udccal.simulation.truth import RigTruth, draw_truth, pixels_to_directions


@pytest.fixture(scope="module")
def truth() -> RigTruth:
    return draw_truth(load_rig("lg55-reduced"), seed=4)


def test_true_geometry_looks_where_the_simulated_camera_looks(truth: RigTruth) -> None:
    pixels = np.array([[0.0, 0.0], [1023.0, 767.0], [300.0, 500.0]])
    fitted = in_float64(lambda: np.asarray(panel_directions(true_geometry(truth), pixels)))()
    assert np.abs(fitted - pixels_to_directions(truth.optics, pixels)).max() < 1e-9


def test_a_perfect_lens_has_no_ray_error_however_it_is_turned(truth: RigTruth) -> None:
    exact = true_geometry(truth)
    assert ray_error_px(exact, truth) < 1e-6
    turned = Rotation.from_rotvec([0.002, -0.003, 0.004]) * Rotation.from_rotvec(np.asarray(exact.rotation_rad))
    assert ray_error_px(replace(exact, rotation_rad=turned.as_rotvec()), truth) < 1e-6


def test_a_wrong_centre_is_forgiven_as_far_as_a_rotation_explains_it(truth: RigTruth) -> None:
    exact = true_geometry(truth)
    moved = ray_error_px(
        replace(exact, principal_point_px=np.asarray(exact.principal_point_px) + np.array([1.0, 0.0])), truth
    )
    assert 1e-3 < moved < 1.0


def test_a_wrong_focal_length_shows(truth: RigTruth) -> None:
    exact = true_geometry(truth)
    # 0.1 % at the edge of the picture, some 600 px from the middle.
    error = ray_error_px(replace(exact, focal_px=1.001 * np.asarray(exact.focal_px)), truth)
    assert error == pytest.approx(0.55, abs=0.12)


def test_names_of_true_values_are_unique_in_their_term(truth: RigTruth) -> None:
    names = [(value.term, value.name) for value in true_values(truth)]
    assert len(names) == len(set(names))


def test_every_estimate_of_the_shipped_profile_has_its_truth_but_those_of_the_model_alone() -> None:
    profile = load_profile("lg55-reduced")
    known = {(one.term, one.name) for one in true_values(draw_truth(load_rig("lg55-reduced"), 0))}
    of_the_model = {
        ("psf", "blur_px"),
        ("psf", "kernel_relative_l2"),
        ("psf", "blur_growth_radial"),
        ("psf", "blur_growth_tangential"),
        ("psf", "blur_red"),
        ("psf", "blur_blue"),
        ("backscatter", "softness_px"),
        ("backscatter", "reflection"),
    }
    sections = {term: getattr(profile, term) for term in ("noise", "geometry", "wire", "psf", "backscatter")}
    estimates = {(term, one.name) for term, section in sections.items() for one in section.estimates}
    # How the light of a wire flat falls over the sensor is the lamp's and the lens's, not the rig's.
    given = {(term, name) for term, name in estimates if not name.startswith("baseline.")}
    assert given - known == of_the_model
    assert known <= given


def test_whole_periods_are_no_error() -> None:
    offset = TrueValue("wire", "offset_x_periods", 961.02, 1.0)
    assert offset.error_of(0.03) == pytest.approx(0.01)
    assert offset.error_of(0.99) == pytest.approx(-0.03)
    assert TrueValue("wire", "row_open", 0.4).error_of(1.4) == pytest.approx(1.0)


def test_a_table_shows_dashes_where_nothing_is_known() -> None:
    rows = (
        TruthRow("noise", "K_DN_per_e", "DN/e", 0.3472, 0.3471, 1e-4, 2e-4),
        TruthRow("wire", "map, RMS", "%", None, None, 0.031, None),
    )
    table = truth_table(rows)
    assert table.rows[0] == ("noise", "gain", "0.34720", "0.34710", "0.00010", "0.00020", "DN/e")
    assert table.rows[1] == ("wire", "map, RMS", "–", "–", "0.031", "–", "%")


def test_half_a_turn_is_the_same_from_both_sides(truth: RigTruth) -> None:
    roll = next(one for one in true_values(truth) if one.name == "roll_deg")
    assert replace(roll, value=-179.99).error_of(179.99) == pytest.approx(-0.02)
