from __future__ import annotations

import time

from tests.live.conftest import raw_frame
from udccal.live.pacing import looped, paced


def test_a_loop_keeps_the_clocks_pace_and_numbers() -> None:
    frames = looped([raw_frame(7), raw_frame(8), raw_frame(9)], 100.0)
    start = time.monotonic()
    numbers = [next(frames).frame_id for _ in range(11)]
    assert time.monotonic() - start >= 0.1
    assert numbers == sorted(set(numbers))


def test_frames_that_nobody_asked_for_in_time_are_lost() -> None:
    frames = looped([raw_frame(0)], 100.0)
    first = next(frames).frame_id
    time.sleep(0.1)
    assert next(frames).frame_id - first >= 10


def test_files_are_paced_and_none_is_lost() -> None:
    start = time.monotonic()
    frames = paced([raw_frame(number) for number in range(4)], 50.0)
    first = next(frames)
    time.sleep(0.1)
    assert [first.frame_id, *(frame.frame_id for frame in frames)] == [0, 1, 2, 3]
    assert time.monotonic() - start >= 0.14
