from __future__ import annotations

import numpy as np

from tests.simulation.toy import toy_truth
from udccal.simulation.panel import column_open_interval, pupil_footprint, row_open_interval


def test_opening_is_centred_without_obliquity():
    truth = toy_truth()
    for interval, fraction in (
        (row_open_interval, truth.panel.row_open),
        (column_open_interval, truth.panel.column_open),
    ):
        start, width = interval(truth, np.zeros(1))
        assert np.allclose(start, -fraction / 2)
        assert np.allclose(width, fraction)


def test_opening_narrows_on_the_side_of_the_slope():
    truth = toy_truth()
    thickness = truth.panel.depth_mm / truth.panel.pitch_mm
    start, width = row_open_interval(truth, np.array([-0.5, 0.5, 1e3]))
    assert np.allclose(width, [truth.panel.row_open - thickness / 2] * 2 + [0.0])
    # A ray that rises with z must start low enough to leave the far side of the structure still inside the opening.
    assert np.isclose(start[1], -truth.panel.row_open / 2)
    assert np.isclose(start[0] + width[0], truth.panel.row_open / 2)


def test_footprint_is_the_pupil_seen_along_the_ray():
    truth = toy_truth()
    direction = np.array([0.3, 0.4, 0.8])
    centre, shape = pupil_footprint(truth, direction / np.linalg.norm(direction))
    edge = np.array([0.6, 0.8])
    pupil_point = truth.optics.pupil_mm + truth.optics.R_panel_camera[:, :2] @ edge * truth.optics.pupil_diameter_mm / 2
    expected = pupil_point[:2] - pupil_point[2] * direction[:2] / direction[2]
    assert np.allclose(centre + shape @ edge, expected)
