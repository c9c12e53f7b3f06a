"""The newest frame on demand: at no cost to the capture, at little to the computer."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from tests.web.capture import SAMPLING, frame
from udccal.cameras.protocol import Frame
from udccal.web.picture import Picture, make_picture
from udccal.web.view import PERIOD_S, LiveView

NOTHING = Picture(b"", np.zeros((3, 64), dtype=np.int64), 0.0)


def test_a_picture_is_made_of_the_newest_frame_and_only_when_somebody_asks() -> None:
    made: list[int] = []

    def make(one: Frame) -> Picture:
        made.append(one.frame_id)
        return NOTHING

    view = LiveView(make)
    assert view.newer(0) is None
    for seed in range(5):
        view.look(frame(seed=seed), ())
    assert made == []
    newest = view.newer(0)
    assert newest is not None
    assert newest.number == 5
    assert view.newer(0) is newest
    assert view.newer(5) is None
    assert made == [4]


@pytest.mark.parametrize(("making_s", "wait_s"), [(0.001, PERIOD_S), (0.06, 0.6)])
def test_pictures_are_made_five_times_a_second_or_less_often_where_they_take_long(
    making_s: float, wait_s: float
) -> None:
    now_s = spent_s = 0.0

    def make(one: Frame) -> Picture:
        nonlocal spent_s
        spent_s += making_s
        return NOTHING

    view = LiveView(make, lambda: now_s, lambda: spent_s)
    view.look(frame(64, 48), ())
    assert view.newer(0) is not None
    view.look(frame(64, 48), ())
    now_s = 0.99 * wait_s
    assert view.newer(1) is None
    now_s = 1.01 * wait_s
    assert view.newer(1) is not None


def test_the_capture_never_waits_for_a_picture_that_is_made() -> None:
    making, go = threading.Event(), threading.Event()

    def make(one: Frame) -> Picture:
        making.set()
        go.wait(10.0)
        return NOTHING

    view = LiveView(make)
    view.look(frame(), ())
    watcher = threading.Thread(target=view.newer, args=(0,), daemon=True)
    watcher.start()
    assert making.wait(10.0)
    late = frame(seed=1)
    start_s = time.monotonic()
    view.look(late, ())
    assert time.monotonic() - start_s < 0.5
    go.set()
    watcher.join()


def test_a_frame_that_makes_no_picture_fails_for_who_watches() -> None:
    def make(one: Frame) -> Picture:
        raise ValueError("no picture")

    view = LiveView(make)
    view.look(frame(), ())
    with pytest.raises(ValueError, match="no picture"):
        view.newer(0)
    view.look(frame(seed=1), ())


@pytest.mark.medium
def test_watching_frames_of_the_largest_rig_takes_less_than_a_fifth_of_a_core() -> None:
    frames = [frame(2048, 1536, (700.0 + 9 * seed, 600.0), seed) for seed in range(4)]
    make_picture(frames[0], SAMPLING)
    view, number, made = LiveView(lambda one: make_picture(one, SAMPLING)), 0, 0
    start_s, busy_s = time.monotonic(), time.process_time()
    while time.monotonic() - start_s < 3.0:
        view.look(frames[made % 4], ())
        newer = view.newer(number)
        if newer is not None:
            made, number = made + 1, newer.number
        time.sleep(0.02)
    share = (time.process_time() - busy_s) / (time.monotonic() - start_s)
    assert made >= 5
    assert share < 0.2, f"{share:.0%} of a core for {made} pictures"
