"""A full calibration as a user runs it: a process of its own, timed, its peak memory read from the system."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class CalibrationRun:
    """What one `udccal calibrate` cost."""

    seconds: float
    peak_GiB: float


def calibrate(rig: str, session: Path, profile: Path, seed: int) -> CalibrationRun:
    """Run `udccal calibrate` on the simulated rig; raises RuntimeError when it fails."""
    command = [sys.executable, "-m", "udccal.cli.main", "calibrate"]
    command += ["--rig", rig, "--session", str(session), "--profile", str(profile), "--seed", str(seed)]
    start = time.monotonic()
    # JAX, imported here, has asked XLA in the environment to be more talkative than the command does.
    child = os.posix_spawn(sys.executable, command, {**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"})
    _, status, usage = os.wait4(child, 0)
    if status != 0:
        code = os.waitstatus_to_exitcode(status)
        raise RuntimeError(f"`udccal calibrate --rig {rig}` failed with exit status {code}.")
    return CalibrationRun(time.monotonic() - start, usage.ru_maxrss / 2**20)
