"""``video:FILE.mp4``: a video file, written under a temporary name and renamed when it is whole."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any, final

import cv2

from udccal.errors import LiveError
from udccal.io.atomic import atomic_path
from udccal.io.out_folder import check_writable, storing_in
from udccal.live.sinks.protocol import RestoredFrame
from udccal.profiles.store import check_outside_profiles

_CODEC = "mp4v"


@final
class VideoSink:
    """Implements ``udccal.live.sinks.protocol.Sink`` with MPEG-4 at a constant rate.

    Where frames were dropped, the one before is repeated, so that the video lasts as long as what it shows.
    """

    def __init__(self, target: str, rate_hz: float) -> None:
        self._path, self._rate_hz = Path(target), rate_hz
        self._naming = ExitStack()
        self._temporary = self._path
        self._writer: Any = None
        self._written = 0
        self._first_ns = 0
        self._last: RestoredFrame | None = None
        with storing_in(self._path.parent):
            fits = self._path.suffix == ".mp4" and self._path.parent.is_dir() and not self._path.is_dir()
        if not fits:
            raise LiveError(
                f"Expected video:FILE.mp4 in a folder that exists, found '{target}'. Choose another name, or make "
                "the folder."
            )
        check_outside_profiles(self._path)
        check_writable(self._path.parent)

    def open(self, shape: tuple[int, int]) -> None:
        """Begin the file under its temporary name."""
        with ExitStack() as naming:
            self._temporary = naming.enter_context(atomic_path(self._path))
            rows, columns = shape
            fourcc = cv2.VideoWriter.fourcc(*_CODEC)
            writer = cv2.VideoWriter(str(self._temporary), cv2.CAP_FFMPEG, fourcc, self._rate_hz, (columns, rows))
            if not writer.isOpened():
                raise LiveError(
                    f"Expected OpenCV to write {self._path} as {_CODEC} video of {columns} x {rows} px, found that it "
                    "cannot. Use --sink images:FOLDER."
                )
            self._writer, self._naming = writer, naming.pop_all()

    def write(self, frame: RestoredFrame) -> None:
        """Write a frame at its time."""
        if self._last is None:
            self._first_ns = frame.captured_ns
        place = round((frame.captured_ns - self._first_ns) * 1e-9 * self._rate_hz)
        while self._last is not None and self._written < place:
            self._put(self._last)
        self._last = frame
        if self._written <= place:
            self._put(frame)

    def close(self) -> None:
        """Finish the file and give it its name.

        Raises:
            LiveError: when it is not whole, as on a full disk; no file is left then.
        """
        if self._writer is None:
            return
        with self._naming:
            self._writer.release()
            found = _frames(self._temporary)
            if found != self._written or found == 0:
                raise LiveError(
                    f"Expected {self._path} to hold {self._written} frames, found {found}. Free space on the disk, and "
                    "let the run last long enough for a frame."
                )

    def _put(self, frame: RestoredFrame) -> None:
        self._writer.write(cv2.cvtColor(frame.picture, cv2.COLOR_RGB2BGR))
        self._written += 1


def _frames(path: Path) -> int:
    """Return the number of frames that a video file says it holds; 0 where it cannot be read."""
    reader = cv2.VideoCapture(str(path))
    try:
        return int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    finally:
        reader.release()
