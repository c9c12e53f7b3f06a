"""The three threads, with a restoration and a sink of the tests."""

from __future__ import annotations

import itertools
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.live.conftest import raw_frame
from udccal.cameras.protocol import Frame
from udccal.errors import CameraLost, LiveError, UdccalError
from udccal.live.hook import Picture, TimedHook
from udccal.live.newest import Newest
from udccal.live.pacing import looped
from udccal.live.pipeline import Limits, Pipeline
from udccal.live.sinks.protocol import RestoredFrame
from udccal.live.sinks.video import VideoSink
from udccal.live.tally import Figures

SHAPE = (4, 6)


class ListSink:
    """Keeps the frames; fails at the one it is told to."""

    def __init__(self, target: str = "", rate_hz: float = 30.0) -> None:
        self.fails_at = int(target or -1)
        self.frames: list[RestoredFrame] = []
        self.calls: list[str] = []

    def open(self, shape: tuple[int, int]) -> None:
        self.calls.append("open")
        assert shape == SHAPE

    def write(self, frame: RestoredFrame) -> None:
        if len(self.frames) == self.fails_at:
            raise OSError(28, "No space left on device")
        self.frames.append(frame)

    def close(self) -> None:
        self.calls.append("close")


def restore(frame: Frame, captured_ns: int) -> Picture:
    return np.full((*SHAPE, 3), frame.frame_id % 251, np.uint8)


def run(
    frames: Iterator[Frame],
    sink: ListSink,
    limits: Limits = Limits(seconds=20.0),  # noqa: B008
    hook: TimedHook | None = None,
    restore: object = restore,
    stop: threading.Event | None = None,
) -> Figures:
    before = threading.active_count()
    try:
        return Pipeline(frames, restore, SHAPE, sink, hook, limits, stop or threading.Event()).run(lambda figures: None)
    finally:
        assert sink.calls == ["open", "close"]
        assert threading.active_count() <= before


def endless(rate_hz: float = 200.0) -> Iterator[Frame]:
    return looped([raw_frame(0)], rate_hz)


@pytest.mark.parametrize(
    "limits", [{"frames": 0}, {"frames": True}, {"seconds": 0.0}, {"seconds": float("nan")}, {"seconds": float("inf")}]
)
def test_limits_that_cannot_be_are_refused(limits: dict[str, float]) -> None:
    with pytest.raises(LiveError, match=r"Expected a (number of frames|time in s) .* found"):
        Limits(**limits)


def test_it_ends_after_so_many_frames() -> None:
    sink = ListSink()
    figures = run(endless(), sink, Limits(frames=5))
    assert figures.written == len(sink.frames) == 5
    ids = [frame.frame_id for frame in sink.frames]
    assert ids == sorted(set(ids))
    assert all(np.all(frame.picture == frame.frame_id % 251) for frame in sink.frames)
    assert figures.latency_ms.p99 is not None


def test_it_ends_after_so_many_seconds() -> None:
    start = time.monotonic()
    figures = run(endless(), ListSink(), Limits(seconds=0.3))
    assert 0.3 <= time.monotonic() - start < 10
    assert figures.written > 0


def test_it_ends_where_the_frames_end_and_the_last_one_is_written() -> None:
    sink = ListSink()
    run(iter([raw_frame(number) for number in range(50)]), sink)
    assert sink.frames[-1].frame_id == 49


def test_a_sink_that_leaves_the_program_ends_it_with_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ListSink, "write", lambda sink, frame: sys.exit("no projector"))
    with pytest.raises(LiveError, match="the output to go on, found SystemExit: no projector"):
        run(endless(), ListSink())


def test_it_ends_when_it_is_told_to() -> None:
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    run(endless(), ListSink(), stop=stop)


def test_every_frame_is_written_or_counted_as_dropped() -> None:
    def slow(frame: Frame, captured_ns: int) -> Picture:
        time.sleep(0.03)
        return restore(frame, captured_ns)

    sink = ListSink()
    figures = run(itertools.islice(endless(), 60), sink, restore=slow)
    assert figures.dropped_before_restoration > 10
    assert figures.captured == figures.written + figures.dropped
    assert figures.restoration_ms.p50 >= 30


def test_written_pictures_are_told_after_the_frames_they_are_of() -> None:
    told: list[tuple[int, int]] = []
    arrived: dict[int, int] = {}

    def noted(frame: Frame, captured_ns: int) -> Picture:
        arrived[frame.frame_id] = captured_ns
        return restore(frame, captured_ns)

    sink, frames = ListSink(), itertools.islice(endless(), 20)

    def wrote(picture: Picture, at_ns: int) -> None:
        told.append((int(picture[0, 0, 0]), at_ns))

    Pipeline(frames, noted, SHAPE, sink, None, Limits(), threading.Event(), wrote).run(lambda figures: None)
    assert [number for number, _ in told] == [frame.frame_id for frame in sink.frames]
    assert all(at_ns > arrived[number] for number, at_ns in told)


def test_frames_that_the_camera_lost_or_broke_are_counted() -> None:
    def frames() -> Iterator[Frame]:
        for number in (0, 1, 5, 6):
            yield raw_frame(number, complete=number != 6)
            time.sleep(0.05)

    figures = run(frames(), ListSink())
    assert (figures.captured, figures.dropped_by_camera, figures.written) == (7, 4, 3)


def test_an_error_of_any_stage_ends_all_with_its_sentence() -> None:
    def unplugged() -> Iterator[Frame]:
        yield raw_frame(0)
        raise CameraLost("Expected the camera, found it unplugged. Plug it in.")

    def broken(frame: Frame, captured_ns: int) -> Picture:
        raise ZeroDivisionError("division by zero")

    for frames, sink, how, error, message in (
        (unplugged(), ListSink(), restore, CameraLost, "unplugged"),
        (endless(), ListSink(), broken, LiveError, "the restoration to go on, found ZeroDivisionError: division"),
        (endless(), ListSink("3"), restore, LiveError, "the output to go on, found OSError: .*No space left"),
    ):
        with pytest.raises(error, match=message) as found:
            run(frames, sink, restore=how)
        assert isinstance(found.value, UdccalError)


def test_the_first_error_is_told_when_closing_fails_too(tmp_path: Path) -> None:
    def broken(picture: Picture, frame_id: int) -> Picture:
        raise ValueError("no cross to draw")

    sink = VideoSink(str(tmp_path / "a.mp4"), 200.0)
    with pytest.raises(LiveError, match="ValueError: no cross to draw"):
        Pipeline(endless(), restore, SHAPE, sink, TimedHook(broken, 10.0), Limits(seconds=20.0), threading.Event()).run(
            lambda figures: None
        )
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("stage", ["acquisition", "restoration"])
def test_an_error_of_another_stage_is_told_before_that_of_closing(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """However late the thread of the error goes on: closing begins when the error has been noted."""

    class Spiteful(ListSink):
        def close(self) -> None:
            super().close()
            raise LiveError("hold 0 frames")

    def close_and_wait(queue: Newest[object]) -> None:
        closes(queue)
        time.sleep(0.2)

    def unplugged() -> Iterator[Frame]:
        if stage == "acquisition":
            raise CameraLost("the first error")
        yield from endless()

    def broken(frame: Frame, captured_ns: int) -> Picture:
        raise LiveError("the first error")

    closes = Newest.close
    monkeypatch.setattr(Newest, "close", close_and_wait)
    with pytest.raises(UdccalError, match="the first error"):
        run(unplugged(), Spiteful(), restore=broken)


def test_an_error_of_closing_alone_is_told(tmp_path: Path) -> None:
    sink = VideoSink(str(tmp_path / "a.mp4"), 200.0)
    with pytest.raises(LiveError, match="hold 0 frames"):
        Pipeline(iter(()), restore, SHAPE, sink, None, Limits(), threading.Event()).run(lambda figures: None)


def test_a_stage_that_does_not_end_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("udccal.live.pipeline._END_WITHIN_S", 0.2)
    go_on = threading.Event()

    def hanging() -> Iterator[Frame]:
        yield raw_frame(0)
        go_on.wait()

    pipeline = Pipeline(hanging(), restore, SHAPE, ListSink(), None, Limits(frames=1), threading.Event())
    with pytest.raises(LiveError, match=r"within 0.2 s, found acquisition still at work"):
        pipeline.run(lambda figures: None)
    go_on.set()


def test_a_late_hook_lets_frames_out_unaltered_and_is_counted() -> None:
    never = threading.Event()

    def stuck(picture: Picture, frame_id: int) -> Picture:
        never.wait()
        return 255 - picture

    sink = ListSink()
    hook = TimedHook(stuck, 0.01)
    figures = run(endless(), sink, Limits(frames=4), hook)
    assert figures.late_hooks == 4
    assert all(np.all(frame.picture == frame.frame_id % 251) for frame in sink.frames)
    sink = ListSink()
    prompt = TimedHook(lambda picture, frame_id: 255 - picture, 10.0)
    assert run(endless(), sink, Limits(frames=4), prompt).late_hooks == 0
    assert all(np.all(frame.picture == 255 - frame.frame_id % 251) for frame in sink.frames)
    never.set()
