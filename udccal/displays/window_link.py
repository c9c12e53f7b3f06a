"""The client of the panel's window: it starts the window's process and waits a bounded time for every reply."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import queue
import subprocess
import sys
import threading
from importlib.metadata import PackageNotFoundError, version
from typing import final

from pydantic import TypeAdapter, ValidationError

from udccal.displays.window_messages import Job, Reply, Request
from udccal.errors import DisplayError

START_S = 30.0
_END_S = 3.0
_LONGEST_LINE = 1 << 16
# One surface pixel is one panel pixel, without tearing; the window stays when a person works on another monitor.
_SDL = {
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
    "SDL_RENDER_VSYNC": "1",
    "SDL_RENDER_SCALE_QUALITY": "nearest",
    "SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS": "0",
    "SDL_VIDEO_ALLOW_SCREENSAVER": "0",
    "SDL_WINDOWS_DPI_AWARENESS": "permonitorv2",
    "SDL_NO_SIGNAL_HANDLERS": "1",
}
_REPLY = TypeAdapter(Reply)


@final
class WindowLink:
    """One process of ``udccal.displays.window_process``, which must be closed."""

    def __init__(self, job: Job) -> None:
        """Start the process; the caller must fetch its first reply with ``reply``.

        Raises:
            DisplayError: when the optional package is not installed.
        """
        _need_pygame()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "udccal.displays.window_process", json.dumps(dataclasses.asdict(job))],
            env=os.environ | _SDL,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def alive(self) -> bool:
        """Whether the process still runs."""
        return self._process.poll() is None

    def ask(self, request: Request, seconds: float) -> Reply:
        """Send a request and wait for its reply; see ``reply``."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{request}\n".encode())
            self._process.stdin.flush()
        except OSError as error:
            raise self._ended() from error
        return self.reply(seconds)

    def reply(self, seconds: float) -> Reply:
        """Wait for the next reply, at most ``seconds``.

        Raises:
            DisplayError: when the reply reports a problem, none comes in time, or the process has ended.
        """
        try:
            line = self._lines.get(timeout=seconds)
        except queue.Empty:
            self._process.kill()  # so that a late reply is not taken as the answer to the next request
            self._process.wait()
            raise DisplayError(
                f"Expected the panel's window to answer within {seconds:g} s, found no answer. Check that the desktop "
                "responds, then try again: a new window is opened."
            ) from None
        if not line:
            self._lines.put(line)
            raise self._ended()
        try:
            reply = _REPLY.validate_json(line)
        except ValidationError as error:
            raise self._ended() from error
        if reply.problem:
            raise DisplayError(reply.problem)
        return reply

    def close(self) -> None:
        """End the process, by force if it does not end by itself."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(OSError):  # the process has ended, and data still to be written is lost
            self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(_END_S)
        self._process.stdout.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        while line := self._process.stdout.readline(_LONGEST_LINE):
            self._lines.put(line)
        self._lines.put(b"")

    def _ended(self) -> DisplayError:
        try:
            status = str(self._process.wait(_END_S))
        except subprocess.TimeoutExpired:
            status = "unknown"
        return DisplayError(
            f"Expected the panel's window to stay open, found that its process ended (status {status}). Run the same "
            "command again; if it happens again, update the graphics driver."
        )


def _need_pygame() -> None:
    try:
        version("pygame-ce")
    except PackageNotFoundError:
        raise DisplayError(
            "Expected the package pygame-ce for a window on the panel, found none. "
            "Install it: pip install 'udccal[window]'"
        ) from None
