from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from procedures.led_walk import nearest_phase_px, phase_distance_px
from procedures.psf import PsfProcedure, field_cells, led_positions_px
from procedures.readings import find_led, head_room, led_change
from tests.guide.painted import PaintedRig, painted_bench, painted_rig
from udccal.arrangements import Led
from udccal.benches.bench import simulated_bench, simulated_rig
from udccal.cameras.protocol import Frame, Region, Settings
from udccal.rig import load_rig
from udccal.sessions.writer import SessionWriter
from udccal.simulation.hand import Hand
from udccal.simulation.world import SimulatedWorld


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


def dark(rows: int, columns: int) -> np.ndarray:
    return np.full((rows, columns), 64, np.uint16)


def speckled(rows: int, columns: int) -> np.ndarray:
    """Single samples that are a code above all others, without neighbours."""
    data = dark(rows, columns)
    data[1::8, 3::8] += 1
    return data


def flooded(rows: int, columns: int) -> np.ndarray:
    return np.full((rows, columns), 4095, np.uint16)


@pytest.mark.parametrize("paint", [dark, speckled, flooded])
def test_frames_without_any_small_light_have_no_led(paint: Callable[[int, int], np.ndarray]) -> None:
    seen = find_led(
        Frame(paint(60, 80), Settings(1e-3, 0.0, Region(100, 200, 80, 60)), 0.0, 0, True), load_rig("lg55-reduced")
    )
    assert seen.peak_DN == 0
    assert np.isfinite(seen.place_px).all()
    assert seen.room.ok is (paint is not flooded)


@pytest.mark.parametrize(
    ("paint", "sentence"),
    [(dark, "No LED is seen."), (speckled, "No LED is seen."), (flooded, "The surroundings are nearly as bright")],
)
def test_a_look_at_no_light_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, paint: Callable[[int, int], np.ndarray], sentence: str
) -> None:
    painted = PaintedRig(painted_rig(psf_columns=2, psf_rows=1))
    bench = painted_bench(painted)
    guided = next(iter(PsfProcedure().guided(painted.rig)))
    monkeypatch.setattr(painted, "_paint", lambda: paint(painted.sensor.rows, painted.sensor.columns))
    with SessionWriter.create(tmp_path / "s", painted.rig, bench.camera.identity) as writer:
        look = guided.begin(bench.camera, bench.display, bench.stage, writer).look()
    assert look.sentence.startswith(sentence)
    assert not look.in_order


def test_head_room_is_bounded_on_both_sides() -> None:
    assert head_room(0.65, 0.65).ok
    assert not head_room(0.95, 0.65).ok
    assert not head_room(0.1, 0.65).ok
    assert head_room(0.1, None).ok


def diffracted(x_px: float, y_px: float, peak_DN: float, rng: np.random.Generator) -> Frame:
    """A frame of an LED behind rows that diffract it into a column of narrow lines, as at the edge of the field."""
    y, x = np.mgrid[:64, :48]
    lines = sum(
        light * np.exp(-((y - y_px - off) ** 2) / 0.5)
        for light, off in ((0.5, -2.9), (1.0, 0.0), (0.9, 2.6), (0.3, 5.1))
    )
    signal = peak_DN * lines * np.exp(-((x - x_px) ** 2) / 0.6)
    signal[::2, ::2] *= 0.4
    signal[1::2, 1::2] *= 0.5
    noise = rng.normal(0, 1, signal.shape) * np.sqrt(4.0 + 0.355 * signal)
    data = np.rint(np.clip(64 + signal + noise, 0, 4095)).astype(np.uint16)
    return Frame(data, Settings(1e-3, 0.0, Region(100, 200, 48, 64)), 0.0, 0, True)


@pytest.mark.parametrize("peak_DN", [800.0, 3000.0])
def test_an_led_that_rests_is_told_from_one_that_moves_by_a_third_of_a_pixel(peak_DN: float) -> None:
    rig, rng = load_rig("lg55-aca2040"), np.random.default_rng(1)
    for x, y in 24 + 2 * rng.random((40, 2)):
        first = diffracted(x, y, peak_DN, rng)
        assert all(led_change(first, diffracted(x, y, k * peak_DN, rng), rig).ok for k in (1.0, 1.0, 0.7, 1.2))
        for right, down in ((0.3, 0.0), (0.0, -0.3), (-0.21, 0.21)):
            assert not led_change(first, diffracted(x + right, y + down, peak_DN, rng), rig).ok
        assert not led_change(first, diffracted(x, y, 0.0, rng), rig).ok


def test_the_place_of_an_led_at_rest_does_not_jump_between_its_orders() -> None:
    rig, rng = load_rig("lg55-aca2040"), np.random.default_rng(2)
    for x, y in 24 + 2 * rng.random((30, 2)):
        places = np.array([find_led(diffracted(x, y, 800.0, rng), rig).place_px for _ in range(6)])
        assert np.ptp(places, axis=0).max() < 0.25


@pytest.mark.slow
def test_an_led_at_the_edge_of_a_full_size_field_is_seen_to_rest_and_to_move(tmp_path: Path) -> None:
    rig = load_rig("lg55-aca2040")
    world = simulated_rig(rig, seed=0)
    guided = next(step for step in PsfProcedure().guided(rig) if step.id == "psf/p30")
    with simulated_bench(world) as bench:
        writer = SessionWriter.create(tmp_path, rig, bench.camera.identity)
        visit = guided.begin(bench.camera, bench.display, Hand(world), writer)
        looks = [visit.look()]
        while not looks[-1].in_order:
            looks.append(visit.look())
            assert len(looks) < 20, looks[-1].sentence
        for _ in range(8):  # at rest it stays in order
            look = visit.look()
            assert look.in_order, look
        shifted_by_0_3_px(world)
        look = visit.look()
        assert look.sentence == "Let the LED rest."
        assert [reading.name for reading in look.readings if not reading.ok] == ["change of the LED's picture"]


def shifted_by_0_3_px(world: SimulatedWorld) -> None:
    """Arrange the LED anew until its image lies 0.3 px from where it was: aims have errors."""
    (x, y), rest_px = world.truth_log[-1].asked_px, world.truth_log[-1].image_px
    for right in np.linspace(0.01, 1.0, 100):
        world.arrange(Led(x + float(right), y, 2000.0, 1.15))
        if np.hypot(*np.subtract(world.truth_log[-1].image_px, rest_px)) == pytest.approx(0.3, abs=0.03):
            return
    pytest.fail("no aim came near")
