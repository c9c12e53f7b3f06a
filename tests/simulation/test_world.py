from __future__ import annotations

import numpy as np
import pytest

from tests.simulation.toy import toy_truth
from udccal.arrangements import Board, BoardSpec, Dark, FlatLight, Led, PanelPicture, Photograph
from udccal.cameras.protocol import Region, Settings
from udccal.displays.pictures import face_picture
from udccal.simulation.disturbances import Disturbances
from udccal.simulation.world import SimulatedWorld

WHOLE = Region(0, 0, 128, 96)
LED = Led(60.0, 50.0, 2000.0, 2.3)


@pytest.fixture(scope="module")
def world() -> SimulatedWorld:
    return SimulatedWorld(toy_truth())


def crowd() -> np.ndarray:
    panel = toy_truth().description.panel
    return face_picture(1, panel.columns, panel.rows)


def frames(world: SimulatedWorld, count: int, period_s: float = 1 / 120) -> list[tuple[int, float]]:
    return [world.next_frame(period_s) for _ in range(count)]


def test_dark_is_dark(world: SimulatedWorld) -> None:
    world.arrange(Dark())
    assert not world.expected_rate(WHOLE).any()


def test_flat_is_the_wire_in_the_colours_of_the_light(world: SimulatedWorld) -> None:
    world.arrange(FlatLight())
    rate = world.expected_rate(WHOLE)
    green = rate[0::2, 1::2]
    np.testing.assert_allclose(green / world.light.wire[0::2, 1::2], green[0, 0] / world.light.wire[0, 1])
    assert rate[1::2, 1::2].mean() / rate[0::2, 0::2].mean() == pytest.approx(0.7 / 0.6, rel=0.01)
    assert green.mean() * 8e-3 == pytest.approx(0.65 * world.truth.sensor.full_well_e, rel=0.01)


def test_led_is_where_the_log_says(world: SimulatedWorld) -> None:
    world.arrange(LED)
    log = world.truth_log[-1]
    assert max(abs(a - b) for a, b in zip(log.asked_px, log.image_px, strict=True)) <= 0.5
    assert log.image_px != log.asked_px
    rate = world.expected_rate(WHOLE)
    green = np.where((np.add.outer(np.arange(96), np.arange(128)) % 2) == 1, rate / world.light.wire, 0.0)
    near = np.s_[36:65, 46:75]
    y, x = np.mgrid[near]
    centroid = (green[near] * [x, y]).sum(axis=(1, 2)) / green[near].sum()
    np.testing.assert_allclose(centroid, log.image_px, atol=0.15)
    assert np.abs(centroid - np.array(log.image_px)[::-1]).max() > 1.0


def test_led_does_not_depend_on_the_region_asked_for(world: SimulatedWorld) -> None:
    world.arrange(LED)
    part = Region(40, 30, 36, 40)
    alone = world.expected_rate(part).copy()
    world.arrange(LED)
    inside = world.expected_rate(WHOLE)[30:70, 40:76]
    assert np.abs(alone - inside).max() < 1e-3 * inside.max()


def test_led_fills_the_well_in_100_us(world: SimulatedWorld) -> None:
    world.arrange(LED)
    brightest = world.expected_rate(WHOLE).max() * 100e-6 / world.truth.sensor.full_well_e
    assert 0.3 < brightest <= 0.81


def test_led_light_ends_with_its_support() -> None:
    world = SimulatedWorld(toy_truth(), led_support=(10, 12))
    world.arrange(LED)
    lit = np.argwhere(world.expected_rate(WHOLE) > 0)
    assert (np.abs(lit - [50, 60]).max(axis=0) <= [13, 15]).all()
    assert not world.expected_rate(Region(0, 0, 16, 16)).any()


@pytest.mark.medium
def test_lit_panel_adds_before_the_wire(world: SimulatedWorld) -> None:
    radiance = np.random.default_rng(0).random((20, 30, 3))
    rates = []
    for panel_picture in (None, crowd()):
        world.arrange(Photograph(radiance, 1500.0, 2000.0, panel_picture))
        rates.append(world.expected_rate(WHOLE))
    world.arrange(PanelPicture(crowd()))
    alone = world.expected_rate(WHOLE)
    np.testing.assert_allclose(rates[1] - rates[0], alone, rtol=1e-6)
    np.testing.assert_allclose(alone, world.light.backscatterer.rate(crowd()) * world.light.wire)


@pytest.mark.medium
def test_board_shows_black_and_white(world: SimulatedWorld) -> None:
    world.arrange(Board(BoardSpec(9, 7, 8.0, 6.0), (0.0, 0.0, 0.0), (570.0, 290.0, 400.0)))
    rate = world.expected_rate(WHOLE) / world.light.wire
    assert rate.max() > 4 * rate.min() > 0


def test_leak_reaches_the_dark() -> None:
    world = SimulatedWorld(toy_truth(), Disturbances(leak_e_per_s=1e4))
    np.testing.assert_allclose(world.expected_rate(WHOLE), 1e4)


def test_flicker_changes_flats_only(world: SimulatedWorld) -> None:
    flickering = SimulatedWorld(toy_truth(), Disturbances(flicker_fraction=0.1, flicker_hz=100.0))
    settings = Settings(1e-3, 0.0, WHOLE)
    for arrangement, varies in ((FlatLight(), True), (PanelPicture(crowd()), False)):
        flickering.arrange(arrangement)
        means = [flickering.rate_during(settings, t).mean() for _, t in frames(flickering, 12)]
        assert (np.ptp(means) > 0.1 * np.mean(means)) == varies
    world.arrange(FlatLight())
    steady = [world.rate_during(settings, t).mean() for _, t in frames(world, 12)]
    assert np.ptp(steady) == 0.0


def test_flicker_averages_out_over_whole_periods() -> None:
    disturbances = Disturbances(flicker_fraction=0.1, flicker_hz=100.0)
    assert disturbances.flicker(0.0031, 0.02) == pytest.approx(1.0, abs=1e-9)
    assert abs(disturbances.flicker(0.0, 1e-4) - 1) > 0.09


def test_dropped_frames_leave_gaps() -> None:
    world = SimulatedWorld(toy_truth(), Disturbances(dropped_frame_every=4))
    numbers, times = zip(*frames(world, 7), strict=True)
    assert numbers == (0, 1, 2, 4, 5, 6, 8)
    np.testing.assert_allclose(times, np.array(numbers) / 120)


def test_knock_moves_the_camera_from_its_frame_on() -> None:
    world = SimulatedWorld(toy_truth(), Disturbances(knock_at_frame=2))
    world.arrange(FlatLight())
    before = world.expected_rate(WHOLE)
    frames(world, 2)
    assert world.expected_rate(WHOLE) is not None
    np.testing.assert_array_equal(world.expected_rate(WHOLE), before)
    frames(world, 1)
    assert np.linalg.norm(world.truth.optics.pupil_mm - toy_truth().optics.pupil_mm) == pytest.approx(0.05)
    assert np.abs(world.expected_rate(WHOLE) / before - 1).max() > 1e-3


def test_a_smudge_takes_light_away_where_it_is() -> None:
    dirty = SimulatedWorld(toy_truth(), Disturbances(smudge_fraction=0.05, smudge_px=(30.0, 60.0, 8.0)))
    clean = SimulatedWorld(toy_truth())
    for world in (dirty, clean):
        world.arrange(FlatLight())
    part = Region(20, 40, 64, 48)
    left = dirty.expected_rate(part) / clean.expected_rate(part)
    assert left[20, 10] == pytest.approx(0.95)
    assert left[0, 60] == pytest.approx(1.0, abs=1e-6)


def test_same_seed_same_aim() -> None:
    images = []
    for seed in (0, 0, 1):
        world = SimulatedWorld(toy_truth(), seed=seed)
        world.arrange(LED)
        images.append(world.truth_log[-1].image_px)
    assert images[0] == images[1] != images[2]
