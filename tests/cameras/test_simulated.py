from __future__ import annotations

import numpy as np
import pytest

from tests.cameras.toy_world import flat_world
from udccal.cameras.faults import CameraFaults
from udccal.cameras.protocol import Counts, Frame, Mode, Region, Settings, Trigger
from udccal.cameras.simulated import SimulatedCamera
from udccal.errors import CameraError, CameraLost, CameraTimeout
from udccal.simulation.disturbances import Disturbances
from udccal.simulation.world import SimulatedWorld

REGION = Region(8, 4, 64, 48)


def taken(world: SimulatedWorld, count: int, exposure_s: float = 4e-3, mode: Mode | None = None) -> list[Frame]:
    with SimulatedCamera(world) as camera:
        camera.set_mode(mode or camera.mode)
        camera.configure(Settings(exposure_s, 0.0, REGION))
        return list(camera.frames(count))


def test_is_the_camera_of_the_rig() -> None:
    camera = SimulatedCamera(flat_world())
    assert (camera.sensor, camera.cfa, camera.bits) == (Region(0, 0, 128, 96), "GBRG", 12)
    assert camera.identity.backend == "simulated"
    assert camera.features.pixel_formats == ("BayerGB12",)


def test_frames_carry_settings_numbers_and_times() -> None:
    frames = taken(flat_world(), 6)
    assert [f.frame_id for f in frames] == list(range(6))
    np.testing.assert_allclose(np.diff([f.timestamp_s for f in frames]), 1 / 120)
    assert all(f.settings == Settings(4e-3, 0.0, REGION) and f.complete for f in frames)
    assert all(f.data.shape == (48, 64) and f.data.dtype == np.uint16 for f in frames)


def test_long_exposures_slow_the_camera_down() -> None:
    times = [f.timestamp_s for f in taken(flat_world(), 3, exposure_s=0.5)]
    np.testing.assert_allclose(np.diff(times), 0.5)


@pytest.mark.parametrize("rate_hz", [0.5, 25.0, 120.0])
def test_frame_rate_paces_the_simulated_clock(rate_hz: float) -> None:
    times = [f.timestamp_s for f in taken(flat_world(), 4, mode=Mode("BayerGB12", rate_hz))]
    np.testing.assert_allclose(np.diff(times), 1 / rate_hz)


@pytest.mark.parametrize("rate_hz", [0.0, 121.0, float("nan")])
def test_refuses_a_rate_that_the_rig_does_not_have(rate_hz: float) -> None:
    with pytest.raises(CameraError, match=r"a frame rate in Hz from 0\.01 to 120"):
        taken(flat_world(), 1, mode=Mode("BayerGB12", rate_hz))


def test_triggered_by_software_nothing_is_exposed_before_it_is_asked_for() -> None:
    for trigger, ahead in ((Trigger.SOFTWARE, 0), (Trigger.FREE_RUN, 2)):
        world = flat_world()
        with SimulatedCamera(world) as camera:
            camera.set_mode(Mode("BayerGB12", trigger=trigger))
            stream = camera.frames(5)
            next(stream)
            assert world.next_frame(1.0)[0] == 1 + ahead


def test_frames_hold_the_expected_light() -> None:
    world = flat_world()
    sensor = world.truth.sensor
    mean = np.mean([f.data for f in taken(world, 40)], axis=0)
    electrons = (mean - sensor.black_DN) / sensor.K_DN_per_e
    expected = world.expected_rate(REGION) * 4e-3
    assert electrons.mean() == pytest.approx(expected.mean(), rel=2e-3)
    assert np.corrcoef(electrons.ravel(), expected.ravel())[0, 1] > 0.999
    assert np.corrcoef(np.roll(electrons, 1, axis=1).ravel(), expected.ravel())[0, 1] < 0.9


def test_noise_is_new_in_every_frame_and_the_same_again_with_the_seed() -> None:
    first, again, other = (taken(flat_world(seed=seed), 3) for seed in (0, 0, 1))
    assert all((a.data == b.data).all() for a, b in zip(first, again, strict=True))
    assert (first[0].data != first[1].data).any()
    assert (first[0].data != other[0].data).any()


def test_second_camera_on_the_same_world_does_not_repeat_noise() -> None:
    world = flat_world()
    first, second = taken(world, 1), taken(world, 1)
    assert second[0].frame_id > first[0].frame_id
    assert (first[0].data != second[0].data).any()


def test_frames_are_the_callers_own() -> None:
    first, second = taken(flat_world(), 2)
    kept = second.data.copy()
    first.data[:] = 0
    np.testing.assert_array_equal(second.data, kept)


def test_dropped_frames_skip_numbers() -> None:
    with SimulatedCamera(flat_world(Disturbances(dropped_frame_every=3))) as camera:
        assert [f.frame_id for f in camera.frames(4)] == [0, 1, 3, 4]
        assert camera.counts == Counts(delivered=4, dropped=1)
        assert [f.frame_id for f in camera.frames(3)] == [6, 7, 9]
        assert camera.counts == Counts(delivered=7, dropped=3)


def test_knock_happens_between_frames() -> None:
    knocked = taken(flat_world(Disturbances(knock_at_frame=20, knock_mm=(0.0, 0.3, 0.0))), 40)
    steady = taken(flat_world(), 40)
    assert all((a.data == b.data).all() for a, b in zip(knocked[:20], steady[:20], strict=True))
    moved, noise = (
        np.mean([a.data.mean(axis=1) - b.data.mean(axis=1) for a, b in pairs], axis=0)
        for pairs in (zip(knocked[20:], steady[20:], strict=True), zip(steady[:20], steady[20:], strict=True))
    )
    assert moved.std() > 4 * noise.std()


@pytest.mark.parametrize(
    "settings",
    [
        Settings(1e-6, 0.0, REGION),
        Settings(100.0, 0.0, REGION),
        Settings(float("nan"), 0.0, REGION),
        Settings(4e-3, -1.0, REGION),
        Settings(4e-3, 25.0, REGION),
        Settings(4e-3, 0.0, Region(1, 4, 64, 48)),
        Settings(4e-3, 0.0, Region(8, 4, 63, 48)),
        Settings(4e-3, 0.0, Region(80, 4, 64, 48)),
        Settings(4e-3, 0.0, Region(8, -2, 64, 48)),
        Settings(4e-3, 0.0, Region(8, 4, 0, 48)),
    ],
)
def test_refuses_what_it_cannot_do(settings: Settings) -> None:
    with SimulatedCamera(flat_world()) as camera, pytest.raises(CameraError, match=r"Expected .* found .*\. \w+"):
        camera.configure(settings)


def test_refuses_to_deliver_when_closed() -> None:
    camera = SimulatedCamera(flat_world())
    with pytest.raises(CameraError, match="open"):
        camera.frames(1)


def test_incomplete_frames_lack_their_lower_half_and_are_counted() -> None:
    with SimulatedCamera(flat_world(), CameraFaults(incomplete_every=3)) as camera:
        frames = list(camera.frames(7))
        assert [f.complete for f in frames] == [True, True, False, True, True, False, True]
        assert camera.counts == Counts(delivered=7, incomplete=2)
    assert not frames[2].data[48:].any()
    assert frames[2].data[:48].any(axis=1).all()
    assert all(f.data.any(axis=1).all() for f in frames if f.complete)


def test_repeated_frames_keep_their_number() -> None:
    with SimulatedCamera(flat_world(), CameraFaults(repeat_every=3)) as camera:
        frames = list(camera.frames(5))
        assert [f.frame_id for f in frames] == [0, 1, 1, 3, 4]
        assert camera.counts == Counts(delivered=5, dropped=1)
    np.testing.assert_array_equal(frames[1].data, frames[2].data)
    assert not np.shares_memory(frames[1].data, frames[2].data)


def test_a_frame_that_times_out_is_followed_by_others() -> None:
    with SimulatedCamera(flat_world(), CameraFaults(time_out_at_frame=2)) as camera:
        stream = camera.frames(5)
        before = [next(stream), next(stream)]
        with pytest.raises(CameraTimeout, match="frame 2"):
            next(stream)
        assert camera.counts == Counts(delivered=2, dropped=1)
        after = list(camera.frames(2))
        assert min(f.frame_id for f in after) > max(f.frame_id for f in before) + 1


def test_an_unplugged_camera_is_lost_until_it_is_opened_again() -> None:
    camera = SimulatedCamera(flat_world(), CameraFaults(unplug_at_frame=3))
    with camera:
        stream = camera.frames(5)
        for _ in range(3):
            next(stream)
        with pytest.raises(CameraLost, match="unplugged"):
            next(stream)
        for use in (lambda: camera.frames(1), lambda: camera.configure(Settings(4e-3, 0.0, REGION))):
            with pytest.raises(CameraLost):
                use()
        assert camera.counts.delivered == 3
    with camera:
        assert len(list(camera.frames(4))) == 4


def test_faults_leave_other_frames_as_they_are() -> None:
    clean = taken(flat_world(), 4)
    with SimulatedCamera(flat_world(), CameraFaults(incomplete_every=3)) as camera:
        camera.configure(Settings(4e-3, 0.0, REGION))
        faulty = list(camera.frames(4))
    assert [(a.data == b.data).all() for a, b in zip(clean, faulty, strict=True)] == [True, True, False, True]
