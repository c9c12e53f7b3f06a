"""Full simulated captures in processes that are killed at random moments and begun again, until they are done.

python -m tests.sessions.killed_captures FOLDER --kills 100

A process of its own: it forks, and must do so before OpenCV has begun threads, which a fork would wait for in vain.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from udccal.benches.bench import simulated_bench, simulated_rig
from udccal.benches.capture import capture
from udccal.calibration import ORDER
from udccal.rig import RigDescription, load_rig
from udccal.sessions.manifest import read_manifest
from udccal.sessions.schema import TermName
from udccal.simulation.world import SimulatedWorld

_LIMIT_S = 400.0
_FEW = {
    "flats": 20,
    "noise_levels": 4,
    "noise_stack": 2,
    "psf_columns": 2,
    "psf_rows": 1,
    "psf_shifts": 2,
    "psf_exposures": 4,
    "psf_region_columns": 32,
    "psf_region_rows": 64,
    "backscatter_pictures": 3,
    "backscatter_frames": 2,
}


@dataclass(frozen=True)
class Work:
    """What is to be captured."""

    rig: RigDescription
    world: SimulatedWorld
    terms: tuple[TermName, ...]


def small_rig(coarser: int) -> RigDescription:
    """The reduced rig with so many times fewer and larger pixels, and few captures."""
    rig = load_rig("lg55-reduced")
    camera = rig.camera
    sides = {"columns": camera.columns // coarser, "rows": camera.rows // coarser}
    camera = camera.model_copy(update=sides | {"pitch_um": camera.pitch_um * coarser})
    return rig.model_copy(update={"camera": camera, "captures": rig.captures.model_copy(update=_FEW)})


def capture_once(work: Work, folder: Path) -> None:
    """What ``udccal calibrate`` captures, in this process."""
    with simulated_bench(work.world) as bench:
        capture(folder, bench, work.terms)


def contents(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a session, hidden ones included."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def capture_with_kills(work: Work, folder: Path, rng: np.random.Generator, within_s: float) -> int:
    """Capture, killing the process (SIGKILL) after a random time again and again; each time the next one goes on.

    Returns:
        How often it was killed.

    Raises:
        AssertionError: when a completed step was lost or captured again, a process failed by itself, or the end is
            never reached.
    """
    kills, completed = 0, dict[str, tuple[int, ...]]()
    context = multiprocessing.get_context("fork")
    end = time.monotonic() + _LIMIT_S
    while time.monotonic() < end:
        process = context.Process(target=capture_once, args=(work, folder))
        process.start()
        process.join(float(rng.uniform(0.0, within_s)))
        if process.exitcode is None:
            process.kill()
            process.join(10)
            kills += 1
        now = _completed(folder)
        repeated = [step for step, written in completed.items() if now.get(step) != written]
        if repeated:
            raise AssertionError(f"expected completed steps to stay as they were, found others for {repeated}")
        if process.exitcode == 0:
            return kills
        if process.exitcode != -signal.SIGKILL:
            raise AssertionError(f"expected the capture to end by itself or by a signal, found {process.exitcode}")
        # On a busy machine a step may take longer than it was given.
        within_s = within_s if len(now) > len(completed) else 1.2 * within_s
        completed = now
    raise AssertionError(f"expected the capture to end within {_LIMIT_S} s, found that it did not")


def compare(folder: Path, work: tuple[Work, Work], kills: int, within_s: float) -> str:
    """Capture once without interruption, then as often as it takes to be killed so many times; all must be the same.

    Args:
        folder: for the sessions.
        work: one and the same twice; the first is captured in this process, the second only in forks of it.
        kills: at least so many.
        within_s: of a process's beginning it is killed, or it ends.

    Raises:
        AssertionError: when a session differs in a bit.
    """
    rng, done, sessions = np.random.default_rng(11), 0, 0
    capture_once(work[0], folder / "whole")
    expected = contents(folder / "whole")
    while done < kills:
        killed = folder / f"killed{sessions}"
        done += capture_with_kills(work[1], killed, rng, within_s)
        found = contents(killed)
        if found != expected:
            different = sorted(name for name in {*found, *expected} if found.get(name) != expected.get(name))
            raise AssertionError(f"expected the same session, found that these files differ: {different}")
        sessions += 1
    return f"{done} kills in {sessions} sessions of {len(_completed(folder / 'whole'))} steps, {len(expected)} files"


def _world(rig: RigDescription, terms: tuple[TermName, ...]) -> SimulatedWorld:
    """A simulated rig whose slow parts are worked out, so that a process forked from here is at once at work."""
    world = simulated_rig(rig, seed=3)
    if "geometry" in terms:
        assert world.light.blur is not None
    if "backscatter" in terms:
        assert world.light.backscatterer is not None
    return world


def _completed(folder: Path) -> dict[str, tuple[int, ...]]:
    """Every completed step, and when its files were written."""
    if not (folder / "session.json").exists():
        return {}
    steps = read_manifest(folder).steps
    return {step.id: tuple((folder / capture.file).stat().st_mtime_ns for capture in step.captures) for step in steps}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--coarser", type=int, default=2)
    parser.add_argument("--within-s", type=float, default=3.0)
    parser.add_argument("--term", action="append", choices=ORDER)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    rig, terms = small_rig(arguments.coarser), tuple(arguments.term or ORDER)
    work = Work(rig, _world(rig, terms), terms), Work(rig, _world(rig, terms), terms)
    print(compare(arguments.folder, work, arguments.kills, arguments.within_s))


if __name__ == "__main__":
    main()
