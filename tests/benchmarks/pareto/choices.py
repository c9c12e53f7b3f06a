"""What each choice within a tier trades against the tier's default."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from tests.benchmarks.pareto.restoring import Setup, TierProcess
from tests.benchmarks.pareto.runs import Run, Sight
from udccal.restoration.metrics import psnr
from udccal.restoration.plan import PlanOptions
from udccal.restoration.rectify import Interpolation
from udccal.tiers import Tier


@dataclass(frozen=True)
class Choice:
    """Options of a tier that differ from its default."""

    tier: Tier
    name: str
    options: PlanOptions


CHOICES: Final = (
    Choice(Tier.preview, "interpolation: LINEAR", PlanOptions(interpolation=Interpolation.LINEAR)),
    Choice(Tier.balanced, "interpolation: LINEAR", PlanOptions(interpolation=Interpolation.LINEAR)),
    Choice(Tier.balanced, "interpolation: LANCZOS", PlanOptions(interpolation=Interpolation.LANCZOS)),
    Choice(Tier.balanced, "tiles of 128 x 128", PlanOptions(tile_rows=128, tile_columns=128)),
    Choice(Tier.balanced, "tiles of 512 x 512", PlanOptions(tile_rows=512, tile_columns=512)),
    Choice(Tier.balanced, "kernels at 4 x 5 places", PlanOptions(grid_rows=4, grid_columns=5)),
    Choice(Tier.accurate, "network_views: 1", PlanOptions(network_views=1)),
    Choice(Tier.accurate, "network_views: 2", PlanOptions(network_views=2)),
)


@dataclass(frozen=True)
class Traded:
    """dB of each scene less the default's, and CPU time over the default's."""

    choice: Choice
    gains_dB: tuple[float, ...]
    cpu_ratio: float


def traded(profile: str, sights: Sequence[Sight], runs: Iterable[Run], keep: Path) -> list[Traded]:
    """Measure every choice on some sights.

    Args:
        profile: its path or name.
        sights: of the nineteen.
        runs: of the defaults on the same sights.
        keep: folder of prepared arrays.
    """
    defaults = {(run.tier, run.group, run.scene): run for run in runs}
    found = []
    for choice in CHOICES:
        gains, cpu, default_cpu = [], [], []
        with TierProcess(Setup(profile, choice.tier, choice.options, keep)) as process:
            process.ready_s(sights[0].taken)
            for sight in sights:
                restored = process.restored(sight.taken)
                default = defaults[choice.tier, sight.case.group, sight.case.shot.name]
                gains.append(psnr(sight.after(restored.linear), sight.truth) - default.after_dB)
                cpu.append(restored.cost.cpu_ms)
                default_cpu.append(default.cpu_ms)
        found.append(Traded(choice, tuple(gains), statistics.median(cpu) / statistics.median(default_cpu)))
    return found


def traded_table(found: Iterable[Traded]) -> str:
    """As Markdown."""
    lines = [
        "| tier | choice | dB − the default's | worst scene | CPU time / the default's |",
        "| --- | --- | ---: | ---: | ---: |",
    ]
    for one in found:
        numbers = f"{np.mean(one.gains_dB):+.2f} | {min(one.gains_dB):+.2f} | {one.cpu_ratio:.2f}"
        lines.append(f"| {one.choice.tier} | {one.choice.name} | {numbers} |")
    return "\n".join(lines)
