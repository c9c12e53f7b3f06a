"""Programs that a test starts, and Ctrl-C."""

from __future__ import annotations

import signal


def heeding_ctrl_c() -> None:
    """In a new process: a shell that runs these tests in the background has them ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
