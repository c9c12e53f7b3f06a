"""The process that owns the panel's window: ``python -m udccal.displays.window_process JOB``.

SDL should be used from a process's main thread (on macOS it must be), and a window that responds to the desktop needs a
thread that does nothing else. A separate process has both, whichever thread of the program asks. A fault in a graphics
driver then ends this process, not the capture.

The process reads requests on standard input and answers each with one ``Reply``, a line of JSON. The first reply says
that the window is open. The process ends when its input ends, which also happens when the asking program dies, so that
no picture stays on screen.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable
from functools import partial
from typing import TextIO

import numpy as np
import pygame
from pydantic import TypeAdapter

from udccal.displays.monitors import choose_monitor, seen_monitors
from udccal.displays.panel_window import PanelWindow
from udccal.displays.protocol import PanelSize
from udccal.displays.window_messages import Job, Reply
from udccal.errors import DisplayError

_INVISIBLE = ("dummy", "evdev", "offscreen")  # SDL's drivers without a screen
_WAKE = pygame.event.custom_type()
_IDLE_MS = 200


def main() -> None:
    """Do the job in the first argument."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the asking program, which then ends this one
    job = TypeAdapter(Job).validate_json(sys.argv[1])
    with _private_output() as output:
        _answer(output, partial(_do, job, output))


def _private_output() -> TextIO:
    """Return standard output for replies only; redirect what libraries print to standard error."""
    private = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return private


def _answer(output: TextIO, work: Callable[[], Reply | None]) -> None:
    """Do some work, and send its reply or its error."""
    try:
        reply = work()
    except DisplayError as error:
        reply = Reply(str(error))
    except pygame.error as error:
        reply = Reply(f"Expected SDL to show a window, found: {error}. Update the graphics driver, then try again.")
    if reply is not None:
        print(json.dumps(dataclasses.asdict(reply)), file=output, flush=True)


def _do(job: Job, output: TextIO) -> Reply | None:
    _reach_desktop()
    monitors = seen_monitors()
    if job.monitor is None:
        return Reply(monitors=monitors)
    monitor = choose_monitor(monitors, job.monitor, PanelSize(job.columns, job.rows))
    window = PanelWindow(monitor, alone=len(monitors) == 1)
    try:
        _answer(output, Reply)
        _serve(job, window, output)
    finally:
        window.close()
    return None


def _reach_desktop() -> None:
    try:
        pygame.display.init()
        driver = pygame.display.get_driver()
    except pygame.error as error:
        driver = str(error)
    if not pygame.display.get_init() or driver in _INVISIBLE:
        raise DisplayError(
            f"Expected a desktop to show a window on, found none ({driver}). Run this in a desktop session of this "
            "computer, or set DISPLAY to that of one."
        )


def _serve(job: Job, window: PanelWindow, output: TextIO) -> None:
    picture = np.memmap(job.picture, np.uint8, "r", shape=(job.rows, job.columns, 3))
    requests: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()
    while True:
        window.handle(pygame.event.wait(_IDLE_MS))
        while not requests.empty():
            request = requests.get()
            if not request:
                return
            _answer(output, partial(_fulfil, request, window, picture, job.settle_s))


def _fulfil(request: str, window: PanelWindow, picture: np.memmap, settle_s: float) -> Reply:
    if request == "check":
        window.check()
    else:
        window.show(picture if request == "show" else None, settle_s)
    return Reply()


def _listen(requests: queue.SimpleQueue[str]) -> None:
    """Pass on the lines of standard input, then an empty one at its end."""
    for line in itertools.chain(sys.stdin, [""]):
        requests.put(line.strip())
        pygame.event.post(pygame.event.Event(_WAKE))


if __name__ == "__main__":
    main()
