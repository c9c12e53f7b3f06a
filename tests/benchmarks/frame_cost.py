"""What a tier of restoration costs in a process of its own, which imports nothing else."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.benchmarks.memory import peak_MiB
from tests.benchmarks.pareto.restoring import Taken
from udccal.profiles.profile import Profile
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone, display_exposure
from udccal.tiers import Tier


@dataclass(frozen=True)
class Cost:
    """Seconds from a profile in memory to the first picture; milliseconds of a warm frame, the median; peak memory."""

    start_s: float
    frame_ms: float
    peak_MiB: float


def cost_of(profile: Profile, taken: Taken, tier: Tier, keep: Path) -> Cost:
    """What a tier costs, in this process.

    Args:
        profile: the rig as measured.
        taken: a frame.
        tier: how much is done to it.
        keep: folder of prepared arrays.
    """
    start = time.perf_counter()
    restorer = Restorer.from_profile(profile, tier, keep=keep)
    tone = Tone(display_exposure(restorer.restore(taken.frame, taken.exposure_s, taken.panel_picture)))
    start_s, frame_ms = time.perf_counter() - start, []
    for _ in range(5 if tier is Tier.accurate else 25):
        start = time.perf_counter()
        restorer.display(taken.frame, taken.exposure_s, tone, taken.panel_picture)
        frame_ms.append(1e3 * (time.perf_counter() - start))
    return Cost(start_s, float(np.median(frame_ms[-20:])), peak_MiB())
