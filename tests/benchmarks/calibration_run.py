"""A full calibration as a user runs it: a process of its own, timed, its peak memory read from the system."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from tests.benchmarks.draws import Draw
from udccal.benches.bench import simulated_bench
from udccal.cli.jobs.capture import Wanted, capture_watched
from udccal.cli.jobs.fit import fit_to_profile
from udccal.cli.output import Output
from udccal.sessions.schema import TermName
from udccal.simulation.world import SimulatedWorld


@dataclass(frozen=True)
class CalibrationRun:
    """What one calibration cost."""

    seconds: float
    peak_GiB: float


def calibrate(draw: Draw, session: Path, profile: Path) -> CalibrationRun:
    """Calibrate a simulated rig in a process of its own; raises RuntimeError when that fails."""
    command = [sys.executable, "-m", "tests.benchmarks.calibration_run", str(draw), str(session), str(profile)]
    start = time.monotonic()
    # JAX, imported here, has asked XLA in the environment to be more talkative than the command does.
    child = os.posix_spawn(sys.executable, command, {**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"})
    _, status, usage = os.wait4(child, 0)
    if status != 0:
        code = os.waitstatus_to_exitcode(status)
        raise RuntimeError(f"The calibration of {draw} failed with exit status {code}.")
    return CalibrationRun(time.monotonic() - start, usage.ru_maxrss / 2**20)


def main(draw: Draw, session: Path, profile: Path) -> None:
    """What `udccal calibrate` does, on a specimen that it cannot name: capture all terms, fit, write the profile."""
    output = Output()
    with simulated_bench(SimulatedWorld(draw.truth, seed=draw.seed)) as bench:
        capture_watched(output, bench, Wanted(session, get_args(TermName)))
    fit_to_profile(output, session, profile)


if __name__ == "__main__":
    main(Draw.named(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]))
