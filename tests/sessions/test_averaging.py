from __future__ import annotations

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest

from udccal.cameras.protocol import Frame, Region, Settings
from udccal.errors import CaptureError, UdccalError
from udccal.sessions.averaging import RunningMoments, average_frames
from udccal.sessions.frame_checks import FrameChecks, FrameLimits

ROWS, COLUMNS = 24, 32
LIMITS = FrameLimits(black_DN=64.0, saturation_DN=4095.0)
SETTINGS = Settings(0.01, 0.0, Region(0, 0, COLUMNS, ROWS))


class Script:
    """Delivers frames whose means, ids and completeness a test decides."""

    def __init__(self, means: list[float], ids: list[int] | None = None, torn: tuple[int, ...] = ()) -> None:
        self.rng = np.random.default_rng(0)
        self.means, self.ids, self.torn = means, ids or list(range(len(means))), torn
        self.next = 0

    def frames(self, count: int) -> Iterator[Frame]:
        for _ in range(count):
            if self.next >= len(self.means):
                return
            index, self.next = self.next, self.next + 1
            data = self.rng.normal(self.means[index], 4.0, (ROWS, COLUMNS)).round().clip(0, 4095).astype(np.uint16)
            yield Frame(data, SETTINGS, 0.1 * index, self.ids[index], index not in self.torn, 30.0 + index // 20)


def reasons(average) -> dict[str, int]:
    return {item.reason: item.frames for item in average.rejected}


def test_moments_are_numpys() -> None:
    frames = np.random.default_rng(1).integers(0, 65536, (50, 6, 7)).astype(np.uint16)
    moments = RunningMoments(6, 7)
    for frame in frames:
        moments.add(frame)
    np.testing.assert_allclose(moments.mean(), frames.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(moments.variance(), frames.astype(float).var(axis=0, ddof=1), rtol=1e-6)


def test_a_large_offset_costs_no_digit_of_the_variance() -> None:
    moments = RunningMoments(1, 2)
    for value in (65534, 65535, 65534, 65535):
        moments.add(np.array([[value, 65535]], np.uint16))
    np.testing.assert_allclose(moments.variance(), [[1 / 3, 0.0]], rtol=1e-6)


def test_a_steady_scene_loses_no_frame() -> None:
    average = average_frames(Script([1000.0] * 40).frames, 40, FrameChecks(LIMITS, SETTINGS))
    assert (average.frames, average.rejected) == (40, ())
    assert average.first_timestamp_s == 0.0
    assert average.last_timestamp_s == pytest.approx(3.9)
    assert average.temperature_C == 31.0  # of the last frame
    assert float(average.mean.mean()) == pytest.approx(1000, abs=0.2)
    assert float(average.variance.mean()) == pytest.approx(16.08, rel=0.05)


@pytest.mark.parametrize("place", [0, 3, 20])
def test_a_flicker_is_replaced_wherever_it_comes(place: int) -> None:
    means = [1000.0] * 31
    means[place] = 1040.0
    average = average_frames(Script(means).frames, 30, FrameChecks(LIMITS, SETTINGS))
    assert average.frames == 30
    assert reasons(average) == {"flicker": 1}
    assert float(average.mean.mean()) == pytest.approx(1000, abs=0.2)


def test_a_slow_drift_is_not_a_flicker() -> None:
    means = list(np.linspace(1000, 1010, 60))
    assert average_frames(Script(means).frames, 60, FrameChecks(LIMITS, SETTINGS)).rejected == ()


def test_torn_dropped_and_clipped_frames_are_counted_and_replaced() -> None:
    means = [1000.0] * 24
    means[9] = 4095.0
    ids = [*range(12), *range(14, 26)]
    average = average_frames(Script(means, ids, torn=(4, 5)).frames, 20, FrameChecks(LIMITS, SETTINGS))
    assert average.frames == 20
    assert reasons(average) == {"incomplete": 2, "saturated": 1, "dropped on the way from the camera": 2}


def test_a_saturated_scene_is_refused_with_its_reason() -> None:
    with pytest.raises(CaptureError, match=r"Expected 10 usable frames, found .* saturated"):
        average_frames(Script([4095.0] * 200).frames, 10, FrameChecks(LIMITS, SETTINGS))


def test_a_camera_that_stops_is_refused() -> None:
    with pytest.raises(CaptureError, match="delivered too few"):
        average_frames(Script([1000.0] * 5).frames, 10, FrameChecks(LIMITS, SETTINGS))
    with pytest.raises(UdccalError, match="between 2 and"):
        average_frames(Script([]).frames, 1, FrameChecks(LIMITS, SETTINGS))


@pytest.mark.medium
def test_memory_does_not_grow_with_the_number_of_frames() -> None:
    def peak(count: int) -> int:
        tracemalloc.start()
        average_frames(Script([1000.0] * count).frames, count, FrameChecks(LIMITS, SETTINGS))
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    peak(20)  # what is allocated once
    more_frames_bytes = 380 * ROWS * COLUMNS * 2
    assert peak(400) - peak(20) < more_frames_bytes / 10
