"""What each choice within a tier trades against the tier's default."""

from __future__ import annotations

import contextlib
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from tests.benchmarks.pareto.restoring import Setup, TierProcess
from tests.benchmarks.pareto.runs import Sight
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
    Choice(Tier.balanced, "tiles of 256 x 256", PlanOptions(tile_rows=256, tile_columns=256)),
    Choice(Tier.balanced, "kernels at 4 x 5 places", PlanOptions(grid_rows=4, grid_columns=5)),
    Choice(Tier.accurate, "network_views: 1", PlanOptions(network_views=1)),
    Choice(Tier.accurate, "network_views: 2", PlanOptions(network_views=2)),
)


@dataclass(frozen=True)
class Traded:
    """dB of each scene less the default's, and CPU time over the default's, the median of the scenes."""

    choice: Choice
    gains_dB: tuple[float, ...]
    cpu_ratio: float


def traded(profile: str, sights: Sequence[Sight], keep: Path) -> list[Traded]:
    """Measure every choice on some sights.

    The default restores each sight beside the choice: a computer's speed changes in minutes.

    Args:
        profile: its path or name.
        sights: of the nineteen.
        keep: folder of prepared arrays.
    """
    found = []
    for choice in CHOICES:
        gains, ratios = [], []
        setups = (Setup(profile, choice.tier, options, keep) for options in (PlanOptions(), choice.options))
        with contextlib.ExitStack() as stack:
            default, process = (stack.enter_context(TierProcess(setup)) for setup in setups)
            for one in (default, process):
                one.ready_s(sights[0].taken)
            for sight in sights:
                before, restored = default.restored(sight.taken), process.restored(sight.taken)
                of_default, own = (psnr(sight.after(one.linear), sight.truth) for one in (before, restored))
                gains.append(own - of_default)
                ratios.append(restored.cost.cpu_ms / before.cost.cpu_ms)
        found.append(Traded(choice, tuple(gains), statistics.median(ratios)))
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
