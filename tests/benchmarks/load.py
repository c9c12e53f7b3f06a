"""Ten thousand full-size frames through capture and averaging: memory, throughput, and what plain numpy would take.

python -m tests.benchmarks.load --frames 10000
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import psutil

from procedures.checks import frame_limits
from udccal.arrangements import FlatLight
from udccal.cameras.protocol import Camera, Frame, Settings
from udccal.cameras.simulated import SimulatedCamera
from udccal.rig import RigDescription, load_rig
from udccal.sessions.averaging import average_frames
from udccal.sessions.frame_checks import FrameChecks
from udccal.simulation.truth import draw_truth
from udccal.simulation.world import SimulatedWorld

_EXPOSURE_S = 4e-3
_KEPT = 32  # frames in memory, for what needs no camera
_LOOKS = 20  # at the memory, along the way
_MIB = 1024 * 1024


@dataclass(frozen=True)
class Load:
    """What was measured; memory is the resident set of the whole process in MiB along the way."""

    frames: int
    seconds: float
    frames_per_s: float
    memory_MiB: tuple[float, ...]
    averaging_ms: float
    numpy_mean_ms: float
    numpy_mean_and_variance_ms: float

    @property
    def growth_MiB(self) -> float:
        """Memory at the end beyond that after the first twentieth."""
        return self.memory_MiB[-1] - self.memory_MiB[0]


def measure(rig: RigDescription, count: int) -> Load:
    """Average ``count`` frames of a simulated camera; then compare the time of the averaging alone with numpy's."""
    world = SimulatedWorld(draw_truth(rig, 0))
    world.arrange(FlatLight())
    memory: list[float] = []
    with SimulatedCamera(world) as camera:
        checks = _checks(rig, camera.configure(Settings(_EXPOSURE_S, 0.0, camera.sensor)))
        start = time.perf_counter()
        average = average_frames(_Watched(camera, memory, count).frames, count, checks)
        seconds = time.perf_counter() - start
        kept = list(camera.frames(_KEPT))
    if average.frames != count:
        raise AssertionError(f"expected {count} frames in the average, found {average.frames}")
    return Load(count, seconds, count / seconds, tuple(memory), *_alone(rig, kept))


class _Watched:
    """A camera's frames, with a look at the memory now and then."""

    def __init__(self, camera: Camera, memory: list[float], count: int) -> None:
        self._camera, self._memory = camera, memory
        self._every = max(1, count // _LOOKS)

    def frames(self, count: int) -> Iterator[Frame]:
        for index, frame in enumerate(self._camera.frames(count), start=1):
            yield frame
            if index % self._every == 0:
                self._memory.append(psutil.Process().memory_info().rss / _MIB)
                print(f"  {index} frames, {self._memory[-1]:.0f} MiB", flush=True)


def _alone(rig: RigDescription, kept: list[Frame], repeats: int = 5) -> tuple[float, float, float]:
    """Milliseconds a frame, medians of interleaved repeats: checks and averaging; numpy: mean; mean and variance."""
    stack = np.stack([frame.data for frame in kept])
    taken: list[list[float]] = []
    for _ in range(repeats):
        times = [time.perf_counter()]
        average_frames(lambda count: _replayed(kept, count), 4 * len(kept), _checks(rig, kept[0].settings))
        times.append(time.perf_counter())
        stack.mean(axis=0)
        times.append(time.perf_counter())
        stack.mean(axis=0)
        stack.var(axis=0, ddof=1)
        times.append(time.perf_counter())
        taken.append(np.diff(times).tolist())
    mine, mean, both = np.median(taken, axis=0)
    return 1e3 * mine / (4 * len(kept)), 1e3 * mean / len(kept), 1e3 * both / len(kept)


def _checks(rig: RigDescription, settings: Settings) -> FrameChecks:
    return FrameChecks(frame_limits(rig, settings.exposure_s, dark=False), settings)


def _replayed(kept: list[Frame], count: int) -> Iterator[Frame]:
    for index in range(count):
        yield replace(kept[index % len(kept)], frame_id=index)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", default="lg55-aca2040")
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    rig = load_rig(arguments.rig)
    load = measure(rig, arguments.frames)
    print(f"{load.frames} frames of {rig.camera.columns} x {rig.camera.rows} in {load.seconds:.0f} s")
    print(f"{load.frames_per_s:.1f} frames per second, the simulation of light and noise included")
    print(f"memory {load.memory_MiB[0]:.0f} MiB at first, {load.memory_MiB[-1]:.0f} MiB at last")
    print(f"checks and averaging alone {load.averaging_ms:.1f} ms a frame; of frames already in memory numpy takes")
    print(f"  {load.numpy_mean_ms:.1f} ms for the mean (ratio {load.averaging_ms / load.numpy_mean_ms:.2f})")
    both = load.numpy_mean_and_variance_ms
    print(f"  {both:.1f} ms for mean and variance (ratio {load.averaging_ms / both:.2f})")
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(asdict(load), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
