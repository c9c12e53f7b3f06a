from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from procedures.led_walk import nearest_phase_px, phase_distance_px
from procedures.psf import PsfProcedure, field_cells, led_positions_px
from procedures.readings import find_led, head_room
from udccal.cameras.protocol import Frame, Region, Settings
from udccal.rig import load_rig


@pytest.mark.parametrize("name", ["lg55-aca2040", "lg55-reduced", "mk31-imx1600"])
def test_cells_lie_on_the_sensor_apart_from_each_other(name: str) -> None:
    rig = load_rig(name)
    cells = field_cells(rig)
    assert sorted(cell.place_px for cell in cells) == sorted(map(tuple, led_positions_px(rig).tolist()))
    for cell in cells:
        corners = np.array(cell.outline.points_px)
        assert corners.min() > 0
        assert (corners < [rig.camera.columns - 1, rig.camera.rows - 1]).all()
        # Twenty pixels are aimed for.
        assert min(cell.half_px) >= 20
    for one, other in pairwise(cells):
        apart = np.abs(np.subtract(one.place_px, other.place_px))
        assert (apart > np.add(one.half_px, other.half_px)).any()
        assert (apart == 0).any()  # along a row or a column, so that the ways are short
    ids = [step_id for cell in cells for step_id in cell.step_ids]
    assert sorted(ids) == sorted(step.id for step in PsfProcedure().steps(rig))


def test_places_count_within_the_cell_of_the_pattern() -> None:
    assert nearest_phase_px((5.0, 5.0), []) == 2.0
    assert nearest_phase_px((5.1, 7.0), [(3.0, 1.0)]) == pytest.approx(0.1)
    assert nearest_phase_px((3.9, 1.0), [(2.0, 1.0), (3.0, 2.0)]) == pytest.approx(0.1)
    assert phase_distance_px(8) == pytest.approx(0.4 * 0.76, abs=0.01)
    assert phase_distance_px(2) > phase_distance_px(8)


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.7, 1.2, 1.8])
def test_an_led_is_found_to_some_tenths_of_a_pixel(offset: float) -> None:
    rig = load_rig("lg55-reduced")
    y, x = np.mgrid[:60, :80]
    spot = 2500 * np.exp(-((x - 40 - offset) ** 2 + (y - 30 - offset) ** 2) / 4)
    spot[::2, ::2] *= 0.6
    spot[1::2, 1::2] *= 0.7
    rng = np.random.default_rng(1)
    data = np.rint(np.maximum(64 + spot + rng.normal(0, 2, spot.shape), 0)).astype(np.uint16)
    data[5, 5] = 4000  # a hot pixel
    seen = find_led(Frame(data, Settings(1e-3, 0.0, Region(100, 200, 80, 60)), 0.0, 0, True), rig)
    assert seen.place_px == pytest.approx((140 + offset, 230 + offset), abs=0.25)
    assert seen.room.ok


def test_head_room_is_bounded_on_both_sides() -> None:
    assert head_room(0.65, 0.65).ok
    assert not head_room(0.95, 0.65).ok
    assert not head_room(0.1, 0.65).ok
    assert head_room(0.1, None).ok
