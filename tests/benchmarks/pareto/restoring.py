"""A tier in a process of its own: nothing but it counts to its time and memory.

The process that takes the pictures holds scenes and kernels of the simulation. It sends frames, one after another, and
waits for the pictures.
"""

from __future__ import annotations

import functools
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from tests.benchmarks.memory import peak_MiB, reset_peak
from udccal.restoration.plan import PlanOptions
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone
from udccal.simulation.scene import WHITE_E_PER_S
from udccal.tiers import Tier

# The numbers of a tone do not matter to its time.
_TONE = Tone(1 / WHITE_E_PER_S)


@dataclass(frozen=True)
class Setup:
    """What restores: a profile by its path or name, a tier and its options, and the folder that keeps arrays."""

    profile: str
    tier: Tier
    options: PlanOptions
    keep: Path


@dataclass(frozen=True)
class Taken:
    """A frame as it is given to restoration; the panel's picture is None where it is not known."""

    frame: UInt16[np.ndarray, "rows columns"]
    exposure_s: float
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None


@dataclass(frozen=True)
class Cost:
    """Of a frame from raw to 8 bits: wall time, CPU time, and the peak of the process's resident memory."""

    ms: float
    cpu_ms: float
    peak_MiB: float


@dataclass(frozen=True)
class Restored:
    """Linear light of the view in e-/s, and what it cost."""

    linear: Float32[np.ndarray, "rows columns 3"]
    cost: Cost


class TierProcess:
    """Restores frames in a process of its own while it is open."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown()

    def ready_s(self, taken: Taken) -> float:
        """Seconds to prepare the profile; the first frame, which compiles, is restored and not counted."""
        return self._pool.submit(_prepared_s, self._setup, taken).result()

    def restored(self, taken: Taken) -> Restored:
        """Restore one frame."""
        return self._pool.submit(_restored, self._setup, taken).result()


@functools.cache
def _restorer(setup: Setup) -> Restorer:
    return Restorer.load(setup.profile, setup.tier, setup.options, setup.keep)


def _prepared_s(setup: Setup, taken: Taken) -> float:
    start = time.perf_counter()
    _restorer(setup)
    seconds = time.perf_counter() - start
    _restored(setup, taken)
    return seconds


def _restored(setup: Setup, taken: Taken) -> Restored:
    """For a display, a preview has a path of its own; the other tiers restore and encode.

    The second of two runs counts, as frames of a stream cost: the light of a panel that stands still has been summed.
    """
    restorer = _restorer(setup)
    given = taken.frame, taken.exposure_s, taken.panel_picture
    reset_peak()
    for _ in range(2):
        start, busy = time.perf_counter(), time.process_time()
        if setup.tier is Tier.preview:
            restorer.display(taken.frame, taken.exposure_s, _TONE, taken.panel_picture)
        else:
            linear = restorer.restore(*given)
            _TONE.rgb8(linear)
    cost = Cost(1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - busy), peak_MiB())
    return Restored(restorer.restore(*given) if setup.tier is Tier.preview else linear, cost)
