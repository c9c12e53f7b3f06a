from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.simulation.toy import toy_rig, toy_truth
from udccal.simulation.footprint import open_fraction
from udccal.simulation.truth import RigTruth, draw_truth, pixels_to_directions
from udccal.simulation.wire import relative_illumination, wire_map

PIXELS = np.array([[3.0, 5.0], [64.0, 48.0], [120.3, 90.7], [-400.0, -300.0], [510.0, 420.0]])


def brute_force(truth: RigTruth, direction: np.ndarray, samples: int = 3000) -> float:
    """Trace rays from points of the pupil, in a grid turned so that no edge runs along it."""
    optics, panel = truth.optics, truth.panel
    axis = (np.arange(samples) + 0.5) / samples * 2 - 1
    x, y = np.meshgrid(axis, axis)
    inside = x**2 + y**2 < 1
    turn = 0.5437
    u = np.cos(turn) * x[inside] - np.sin(turn) * y[inside], np.sin(turn) * x[inside] + np.cos(turn) * y[inside]
    passed = np.ones(u[0].size, bool)
    slope = direction[:2] / direction[2]
    for axis_index, fraction in ((0, panel.column_open), (1, panel.row_open)):
        across = optics.R_panel_camera[axis_index, :2], optics.R_panel_camera[2, :2]
        offset = sum(u[i] * (across[0][i] - slope[axis_index] * across[1][i]) for i in (0, 1))
        offset = offset * optics.pupil_diameter_mm / 2 * (1 + optics.pupil_mm[2] / optics.focus_mm)
        enter = optics.pupil_mm[axis_index] - slope[axis_index] * optics.pupil_mm[2] + offset
        leave = enter + slope[axis_index] * panel.depth_mm
        cells = enter / panel.pitch_mm, leave / panel.pitch_mm
        for cell in cells:
            passed &= np.abs(cell - np.rint(cell)) < fraction / 2
        passed &= np.rint(cells[0]) == np.rint(cells[1])
    return float(passed.mean())


@pytest.mark.parametrize("pixel", range(len(PIXELS)))
def test_open_fraction_is_the_area_that_rays_find(pixel: int) -> None:
    truth = toy_truth()
    direction = pixels_to_directions(truth.optics, PIXELS[pixel : pixel + 1])
    exact = open_fraction(truth, direction)[0]
    traced = brute_force(truth, direction[0])
    assert exact == pytest.approx(traced, rel=3e-5)


def test_area_check_notices_a_panel_moved_by_a_hundredth_of_a_pitch() -> None:
    truth = toy_truth()
    moved = replace(truth, optics=replace(truth.optics, pupil_mm=truth.optics.pupil_mm + np.array([0, 0.0063, 0])))
    directions = pixels_to_directions(truth.optics, PIXELS)
    difference = open_fraction(moved, directions) / open_fraction(truth, directions) - 1
    assert np.abs(difference).max() > 1e-4


def test_panel_without_structure_passes_everything() -> None:
    truth = toy_truth()
    bare = replace(truth, panel=replace(truth.panel, row_open=1.0, column_open=1.0, depth_mm=0.0))
    directions = pixels_to_directions(truth.optics, PIXELS)
    np.testing.assert_allclose(open_fraction(bare, directions), 1.0, rtol=1e-12)


def test_map_has_mean_one_and_ripples_with_the_rows() -> None:
    truth = toy_truth()
    wire = wire_map(truth)
    assert wire.shape == (96, 128)
    assert wire.mean() == pytest.approx(1.0, abs=1e-12)
    # A pixel's step in angle moves the ray by stand-off / f on the panel: the period in pixels follows.
    y = np.arange(-300.0, 396.0)
    column = np.stack([np.full_like(y, 64.0), y], axis=-1)
    directions = pixels_to_directions(truth.optics, column)
    rows = (truth.optics.pupil_mm[1] - truth.optics.pupil_mm[2] * directions[:, 1] / directions[:, 2]) / 0.63
    ripple = open_fraction(truth, directions)
    even_rows = np.linspace(rows[0], rows[-1], 1024)
    spectrum = np.abs(np.fft.rfft(np.hanning(1024) * np.interp(even_rows, rows, ripple - ripple.mean())))
    spectrum[:8] = 0
    assert np.argmax(spectrum) == pytest.approx(rows[-1] - rows[0], abs=1.0)


def test_shading_falls_from_the_axis() -> None:
    truth = draw_truth(toy_rig(), 3)
    axis = truth.optics.R_panel_camera[:, 2]
    side = axis + 0.4 * truth.optics.R_panel_camera[:, 0]
    shading = relative_illumination(truth, np.stack([axis, side / np.linalg.norm(side)]))
    assert shading[0] == pytest.approx(1.0)
    assert shading[1] < np.cos(np.arctan(0.4)) ** 4


@pytest.mark.slow
@pytest.mark.parametrize(("rig", "low", "high"), [("lg55-reduced", 18, 26), ("mk31-imx1600", 10, 18)])
def test_periods_from_top_to_bottom(rig: str, low: int, high: int) -> None:
    from udccal.rig import load_rig

    truth = draw_truth(load_rig(rig), 0)
    camera = truth.description.camera
    ends = pixels_to_directions(truth.optics, np.array([[camera.columns / 2, 0.0], [camera.columns / 2, camera.rows]]))
    travel = -truth.optics.pupil_mm[2] * np.diff(ends[:, 1] / ends[:, 2])[0] / truth.panel.pitch_mm
    assert low < travel < high
