from __future__ import annotations

import numpy as np
import pytest

from udccal.arrangements import FlatLight
from udccal.cameras.protocol import Camera, Region, Settings
from udccal.cameras.simulated import SimulatedCamera
from udccal.errors import CameraError
from udccal.rig import load_rig
from udccal.simulation.disturbances import Disturbances
from udccal.simulation.truth import RigTruth, draw_truth
from udccal.simulation.world import SimulatedWorld

REGION = Region(8, 4, 64, 48)


def toy_truth() -> RigTruth:
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 128, "rows": 96, "cfa": "GBRG"})
    return draw_truth(rig.model_copy(update={"camera": camera}))


def flat_world(disturbances: Disturbances | None = None, seed: int = 0) -> SimulatedWorld:
    world = SimulatedWorld(toy_truth(), disturbances, seed)
    world.arrange(FlatLight())
    return world


def taken(world: SimulatedWorld, count: int, exposure_s: float = 4e-3) -> list:
    with SimulatedCamera(world) as camera:
        camera.configure(Settings(exposure_s, 0.0, REGION))
        return list(camera.frames(count))


def test_is_a_camera_that_says_what_it_is() -> None:
    camera = SimulatedCamera(flat_world())
    assert isinstance(camera, Camera)
    assert (camera.sensor, camera.cfa, camera.bits) == (Region(0, 0, 128, 96), "GBRG", 12)
    assert camera.identity.backend == "simulated"


def test_frames_carry_settings_numbers_and_times() -> None:
    frames = taken(flat_world(), 6)
    assert [f.frame_id for f in frames] == list(range(6))
    np.testing.assert_allclose(np.diff([f.timestamp_s for f in frames]), 1 / 120)
    assert all(f.settings == Settings(4e-3, 0.0, REGION) and f.complete for f in frames)
    assert all(f.data.shape == (48, 64) and f.data.dtype == np.uint16 for f in frames)


def test_long_exposures_slow_the_camera_down() -> None:
    times = [f.timestamp_s for f in taken(flat_world(), 3, exposure_s=0.5)]
    np.testing.assert_allclose(np.diff(times), 0.5)


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
    assert [f.frame_id for f in taken(flat_world(Disturbances(dropped_frame_every=3)), 4)] == [0, 1, 3, 4]


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
