from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from udccal.cameras.protocol import Frame, Region, Settings
from udccal.errors import CaptureError
from udccal.sessions.averaging import average_frames
from udccal.sessions.bracket_checks import bracket_fault
from udccal.sessions.frame_checks import FrameChecks, FrameLimits, frames_agree

ROWS, COLUMNS = 192, 256
LIMITS = FrameLimits(black_DN=64.0, saturation_DN=4095.0)
K_DN_PER_E, READ_DN = 0.355, 2.0
SETTINGS = Settings(0.01, 0.0, Region(0, 0, COLUMNS, ROWS))


def light() -> np.ndarray:
    """An uneven scene with an edge, in electrons."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    return 3000.0 + 2000.0 * np.cos(x / 60) * np.cos(y / 50) + 1500.0 * (x > 100)


def frame(electrons: np.ndarray, seed: int, exposure_s: float = 0.01) -> Frame:
    rng = np.random.default_rng(seed)
    noisy = K_DN_PER_E * rng.poisson(electrons) + rng.normal(64, READ_DN, electrons.shape)
    data = noisy.round().clip(0, 4095).astype(np.uint16)
    rows, columns = electrons.shape
    return Frame(data, Settings(exposure_s, 0.0, Region(0, 0, columns, rows)), 0.1 * seed, seed, True)


def average_of(scenes: list[np.ndarray], count: int, limits: FrameLimits = LIMITS) -> dict[str, int]:
    frames = iter([frame(scene, index) for index, scene in enumerate(scenes)])

    def deliver(wanted: int) -> Iterator[Frame]:
        for _ in range(wanted):
            yield next(frames)

    average = average_frames(deliver, count, FrameChecks(limits, SETTINGS))
    assert average.frames == count
    return {item.reason: item.frames for item in average.rejected}


def test_a_steady_scene_of_any_shape_loses_no_frame() -> None:
    assert average_of([light()] * 60, 60) == {}
    assert average_of([0.02 * light()] * 30, 30) == {}  # mostly read noise
    assert average_of([np.zeros((ROWS, COLUMNS))] * 30, 30) == {}


def test_samples_in_another_order_of_bytes_are_the_same() -> None:
    frames = [frame(light(), index) for index in range(10)]
    turned = [replace(one, data=one.data.astype(">u2")) for one in frames]
    a, b = (
        average_frames(lambda _, given=given: iter(given), 10, FrameChecks(LIMITS, SETTINGS))
        for given in (frames, turned)
    )
    np.testing.assert_array_equal(a.mean, b.mean)
    np.testing.assert_array_equal(a.variance, b.variance)


@pytest.mark.parametrize("place", [0, 2, 20])
def test_something_that_passes_by_is_motion(place: int) -> None:
    scenes = [light() for _ in range(32)]
    scenes[place][40:90, 30:80] *= 0.97  # the mean changes by 0.1 %
    assert average_of(scenes, 30) == {"motion": 1}


def test_a_camera_that_is_knocked_for_a_moment_is_motion() -> None:
    scenes = [light() for _ in range(24)]
    scenes[10] = np.roll(light(), 3, axis=1)
    scenes[11] = np.roll(light(), -2, axis=0)
    assert average_of(scenes, 20) == {"motion": 2}


def test_a_change_of_brightness_alone_is_flicker() -> None:
    scenes = [light() for _ in range(24)]
    scenes[9] *= 1.02
    assert average_of(scenes, 20) == {"flicker": 1}


def test_a_slow_change_of_the_light_is_followed() -> None:
    drift = np.linspace(0.0, 1.0, COLUMNS)
    assert average_of([light() * (1 + 1e-4 * index * drift) for index in range(60)], 60) == {}


def test_light_in_a_dark_frame_is_a_leak() -> None:
    scenes = [np.zeros((ROWS, COLUMNS)) for _ in range(14)]
    scenes[5] += 200.0
    assert average_of(scenes, 12, FrameLimits(64.0, 4095.0, dark_DN=94.0)) == {"light leak": 1}
    assert average_of([np.full((ROWS, COLUMNS), 200.0)] * 12, 12) == {}  # light where light is meant


def test_a_frame_delivered_twice_counts_once() -> None:
    frames = [frame(light(), index) for index in range(12)]
    order = [*frames[:6], frames[5], *frames[6:]]
    checks = FrameChecks(LIMITS, SETTINGS)
    assert [item.frame_id for item in checks.accepted(order, 13)] == list(range(12))
    assert [(item.reason, item.frames) for item in checks.rejections()] == [("delivered twice", 1)]


def test_a_replay_of_several_frames_counts_none_of_them_twice() -> None:
    frames = [frame(light(), index) for index in range(12)]
    checks = FrameChecks(LIMITS, SETTINGS)
    order = [*frames[:6], *frames[3:6], *frames[6:]]
    assert [item.frame_id for item in checks.accepted(order, 15)] == list(range(12))
    assert list(checks.sound([frames[11]])) == []  # once more, in the next delivery
    assert [(item.reason, item.frames) for item in checks.rejections()] == [("delivered twice", 4)]


def test_frames_of_other_settings_than_were_asked_for_are_left_out() -> None:
    stale = frame(light(), 0, exposure_s=0.02)
    rounded = frame(light(), 1, exposure_s=0.01002)  # what the camera made of the 0.01
    checks = FrameChecks(LIMITS, SETTINGS)
    assert [item.frame_id for item in checks.sound([stale, rounded])] == [1]
    assert [item.reason for item in checks.rejections()] == ["settings changed"]


def test_a_light_that_changed_for_good_ends_the_capture_soon() -> None:
    asked = 0

    def deliver(count: int) -> Iterator[Frame]:
        nonlocal asked
        for _ in range(count):
            asked += 1
            yield frame(light() * (1.0 if asked <= 40 else 1.02), asked)

    with pytest.raises(CaptureError, match="flicker"):
        average_frames(deliver, 60, FrameChecks(LIMITS, SETTINGS))
    assert asked <= 60 + 20


def test_two_frames_agree_or_do_not() -> None:
    first, second, brighter = frame(light(), 1), frame(light(), 2), frame(1.03 * light(), 3)
    assert frames_agree([first, second], 64.0, 0.01)
    assert not frames_agree([first, brighter], 64.0, 0.01)


def spot(x: float, peak_e: float) -> np.ndarray:
    rows, columns = np.mgrid[:64, :48]
    near = np.exp(-((columns - x) ** 2 + (rows - 32.0) ** 2) / 4.0)
    return peak_e * (near + 3e-3 * np.exp(-((columns - x) ** 2) / 3.0))


@pytest.mark.parametrize(
    ("x", "brightness", "expected"),
    [(24.3, 1.0, None), (24.3, 1.2, "flicker"), (24.3, 0.8, "flicker"), (25.1, 1.0, "motion")],
)
def test_exposures_of_a_bracket_show_one_light(x: float, brightness: float, expected: str | None) -> None:
    for seed in range(10):
        shorter = frame(spot(24.3, 9000.0), 2 * seed, 0.001)
        longer = frame(4 * brightness * spot(x, 9000.0), 2 * seed + 1, 0.004)
        assert bracket_fault(shorter, longer, LIMITS) == expected


def test_nothing_is_said_where_nothing_can_be_compared() -> None:
    dark = frame(np.zeros((64, 48)), 0, 0.001)
    assert bracket_fault(dark, frame(np.zeros((64, 48)), 1, 0.004), LIMITS) is None
