"""``images:FOLDER``: every frame as a PNG file that is never seen half-written."""

from __future__ import annotations

from pathlib import Path
from typing import final

from udccal.errors import LiveError
from udccal.io.out_folder import check_writable, storing_in
from udccal.io.png import write_rgb8
from udccal.live.sinks.protocol import RestoredFrame
from udccal.profiles.store import check_outside_profiles


@final
class ImagesSink:
    """Implements ``udccal.live.sinks.protocol.Sink``; a file's number is the camera's count of the frame."""

    def __init__(self, target: str, rate_hz: float) -> None:
        self._folder = Path(target)
        with storing_in(self._folder):
            taken = self._folder.exists() and not (self._folder.is_dir() and not any(self._folder.iterdir()))
        if not target or taken:
            raise LiveError(
                f"Expected images:FOLDER with a folder that is new or empty, found '{target}'. Choose another folder."
            )
        check_outside_profiles(self._folder)
        check_writable(self._folder)

    def open(self, shape: tuple[int, int]) -> None:
        """Make the folder."""
        self._folder.mkdir(parents=True, exist_ok=True)

    def write(self, frame: RestoredFrame) -> None:
        """Write one file."""
        write_rgb8(self._folder / f"frame-{frame.frame_id:08d}.png", frame.picture)

    def close(self) -> None:
        """No file is open between frames."""
