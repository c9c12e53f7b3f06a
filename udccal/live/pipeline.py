"""Acquisition, restoration and output as three threads, joined by queues of one in which the newest frame wins."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import final

from udccal.arguments import check_count, check_number
from udccal.cameras.protocol import Frame
from udccal.errors import LiveError, UdccalError
from udccal.live.hook import Picture, TimedHook
from udccal.live.newest import Newest
from udccal.live.sinks.protocol import RestoredFrame, Sink
from udccal.live.tally import Figures, Stage, Tally

_SHOW_EVERY_S = 1.0
# The longest that a camera waits for a frame is its time-out of 2 s and an exposure.
_END_WITHIN_S = 20.0


@final
@dataclass(frozen=True)
class Limits:
    """When a run ends by itself; None for never.

    Raises:
        LiveError: when one is no number above 0: of frames a whole one, of seconds one up to a year.
    """

    frames: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        if self.frames is not None:
            check_count(self.frames, "a number of frames", 1, 2**63 - 1, LiveError)
        if self.seconds is not None:
            check_number(self.seconds, "a time in s", (1e-3, 366 * 86400.0), "Leave it out to run on.", LiveError)


@final
@dataclass(frozen=True)
class _Captured:
    frame: Frame
    captured_ns: int


def ignored(picture: Picture, at_ns: int) -> None:
    """Take a written picture and do nothing with it."""


@final
class Pipeline:
    """One live run.

    Args:
        frames: the camera's frames; the run ends where they end.
        restore: returns a frame, which arrived at a time in ns of the monotonic clock, as display-encoded RGB.
        shape: rows and columns of these pictures.
        sink: takes them.
        hook: alters restored frames; None for none.
        limits: when to end.
        stop: ends the run when set; set when the run has ended.
        wrote: gets every picture that the sink has taken, and when, in ns of the monotonic clock.
        tally: counts for this run; None for one of its own.
    """

    def __init__(
        self,
        frames: Iterable[Frame],
        restore: Callable[[Frame, int], Picture],
        shape: tuple[int, int],
        sink: Sink,
        hook: TimedHook | None,
        limits: Limits,
        stop: threading.Event,
        wrote: Callable[[Picture, int], None] = ignored,
        tally: Tally | None = None,
    ) -> None:
        self._wrote = wrote
        self._frames, self._sink, self._hook = frames, sink, hook
        self._restore_frame, self._shape = restore, shape
        self._limits, self._stop = limits, stop
        self._captured: Newest[_Captured] = Newest()
        self._restored: Newest[RestoredFrame] = Newest()
        self._tally = Tally() if tally is None else tally
        self._error: Exception | None = None

    def run(self, show: Callable[[Figures], None]) -> Figures:
        """Run until the limits, the end of the frames, or ``stop``; return the figures of the whole run.

        Args:
            show: gets the figures of every second.

        Raises:
            UdccalError: the first error of any thread; all threads have ended then.
        """
        works = (
            (Stage.ACQUISITION, self._acquire, self._captured.close),
            (Stage.RESTORATION, self._restore, self._restored.close),
            (Stage.OUTPUT, self._output, self._close),
        )
        threads = [threading.Thread(target=self._guarded, args=each, name=each[0], daemon=True) for each in works]
        for thread in threads:
            thread.start()
        try:
            self._wait(show)
        finally:
            self._stop.set()
            self._captured.close()
            for thread in threads:
                thread.join(_END_WITHIN_S)
        if self._error is not None:
            raise self._error
        stuck = [thread.name for thread in threads if thread.is_alive()]
        if stuck:
            raise LiveError(
                f"Expected every stage to end within {_END_WITHIN_S:g} s, found {' and '.join(stuck)} still at work. "
                "Check the camera and the sink."
            )
        return self._tally.whole()

    def _wait(self, show: Callable[[Figures], None]) -> None:
        start = due = time.monotonic()
        end = start + (self._limits.seconds or float("inf"))
        while time.monotonic() < end:
            due += _SHOW_EVERY_S
            if self._stop.wait(max(min(due, end) - time.monotonic(), 0.0)):
                return
            show(self._tally.second())

    def _guarded(self, stage: Stage, work: Callable[[], None], end: Callable[[], None]) -> None:
        """Do a stage's work and end it. An error is noted before: ending wakes the next stage, and may fail too."""
        try:
            self._noting(stage, work)
        finally:
            self._noting(stage, end)

    def _noting(self, stage: Stage, part: Callable[[], None]) -> None:
        try:
            part()
        except BaseException as error:  # sys.exit() of a sink would end this thread without a word
            if self._error is None:
                self._error = _as_sentence(stage, error)
            self._stop.set()

    def _acquire(self) -> None:
        expected: int | None = None
        start = time.monotonic()
        for frame in self._frames:
            captured_ns = time.monotonic_ns()
            self._tally.took(Stage.ACQUISITION, time.monotonic() - start)
            lost = 0 if expected is None else max(frame.frame_id - expected, 0)
            expected = frame.frame_id + 1
            self._tally.captured(lost + 1)
            self._tally.dropped(Stage.ACQUISITION, lost + (not frame.complete))
            if frame.complete and self._captured.put(_Captured(frame, captured_ns)):
                self._tally.dropped(Stage.RESTORATION)
            if self._stop.is_set():
                return
            start = time.monotonic()

    def _restore(self) -> None:
        while (item := self._captured.get()) is not None:
            start = time.monotonic()
            picture = self._restore_frame(item.frame, item.captured_ns)
            self._tally.took(Stage.RESTORATION, time.monotonic() - start)
            if self._restored.put(RestoredFrame(picture, item.frame.frame_id, item.captured_ns)):
                self._tally.dropped(Stage.OUTPUT)

    def _output(self) -> None:
        self._sink.open(self._shape)
        left = self._limits.frames
        while left != 0 and (item := self._restored.get()) is not None:
            self._write(item)
            left = None if left is None else left - 1

    def _close(self) -> None:
        self._stop.set()
        self._sink.close()

    def _write(self, frame: RestoredFrame) -> None:
        start = time.monotonic()
        altered = None if self._hook is None else self._hook.apply(frame.picture, frame.frame_id)
        late = self._hook is not None and altered is None
        if altered is not None:
            frame = RestoredFrame(altered, frame.frame_id, frame.captured_ns)
        self._sink.write(frame)
        self._tally.took(Stage.OUTPUT, time.monotonic() - start)
        written_ns = time.monotonic_ns()
        self._wrote(frame.picture, written_ns)
        self._tally.written((written_ns - frame.captured_ns) * 1e-9, late)


def _as_sentence(stage: Stage, error: BaseException) -> UdccalError:
    if isinstance(error, UdccalError):
        return error
    sentence = LiveError(
        f"Expected the {stage} to go on, found {type(error).__name__}: {error}. Correct the cause and start again; "
        "--debug shows where it was."
    )
    sentence.__cause__ = error
    return sentence
