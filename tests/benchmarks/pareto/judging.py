"""The rows of ``pareto.json`` that say whether tiers are in order, quick and worth their time."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Final

from tests.benchmarks.pareto.groups import COMPARED, Group
from tests.benchmarks.pareto.runs import Run, mean_dB, median_ms, of_group
from tests.benchmarks.rows import Row, at_least, at_most
from udccal.tiers import Tier

# Milliseconds that a frame may take on a sensor of so many samples, that of lg55-aca2040.
_LIMIT_MS: Final = {Tier.preview: 33.0, Tier.fast: 150.0, Tier.balanced: 400.0, Tier.accurate: 20_000.0}
_LIMITS_OF_SAMPLES: Final = 2048 * 1536
# No tier may be worse than the preview on any scene by more than this.
_LOSS_DB: Final = 0.3
# dB that slower tiers gain on the fast one, by group.
_GAINS_DB: Final = {
    (Group.nineteen, Tier.balanced): 1.0,
    (Group.nineteen, Tier.accurate): 2.0,
    (Group.fine, Tier.balanced): 0.7,
    (Group.fine, Tier.accurate): 2.2,
}


def time_rows(runs: Sequence[Run], samples: int) -> list[Row]:
    """Median time of each tier. On a sensor of other size, the limit is scaled by its samples, and the row says so.

    Args:
        runs: of every tier.
        samples: of the rig's sensor.
    """
    scale = samples / _LIMITS_OF_SAMPLES
    said = "" if scale == 1 else f" (limit x {scale:.3g}, for {samples / 1e6:.2g} of {_LIMITS_OF_SAMPLES / 1e6:.2g} MP)"
    rows = []
    for tier in Tier:
        value, limit = median_ms(runs, tier), _LIMIT_MS[tier] * scale
        if tier is Tier.accurate:
            rows.append(at_most(f"{tier} s{said}", value / 1e3, limit / 1e3, "s"))
        else:
            rows.append(at_most(f"{tier} ms{said}", value, limit, "ms"))
    return rows


def order_rows(runs: Sequence[Run]) -> list[Row]:
    """In the compared groups, each tier is better on average than the one before."""
    rows = []
    for group, (quicker, slower) in itertools.product(COMPARED, itertools.pairwise(Tier)):
        gain = mean_dB(of_group(runs, group, slower)) - mean_dB(of_group(runs, group, quicker))
        rows.append(at_least(f"{group}: mean dB of {slower} - {quicker}", gain, 0.0, "dB"))
    return rows


def gain_rows(runs: Sequence[Run]) -> list[Row]:
    """How much the slower tiers gain on the fast one."""
    rows = []
    for (group, tier), least in _GAINS_DB.items():
        gain = mean_dB(of_group(runs, group, tier)) - mean_dB(of_group(runs, group, Tier.fast))
        rows.append(at_least(f"{group}: {tier} - {Tier.fast}", gain, least, "dB"))
    return rows


def loss_rows(runs: Iterable[Run]) -> list[Row]:
    """No tier spoils a scene under any conditions: against the preview, the worst of all cases of every group.

    Raises:
        ValueError: when a run has no preview to compare with.
    """
    runs = list(runs)
    previews = {(run.group, run.scene, run.condition): run for run in runs if run.tier is Tier.preview}
    rows = []
    for tier in list(Tier)[1:]:
        own = [run for run in runs if run.tier is tier]
        missing = [run for run in own if (run.group, run.scene, run.condition) not in previews]
        if missing or not own:
            raise ValueError(f"Expected a run of {tier} and of preview for every case, found {missing or 'none'}.")
        losses = [(run.after_dB - previews[run.group, run.scene, run.condition].after_dB, run) for run in own]
        # What is no number is worst.
        worst, run = min(losses, key=lambda pair: (pair[0] == pair[0], pair[0]))
        name = f"{tier}: worst dB - preview's ({run.scene}, {run.group}: {run.condition})"
        rows.append(at_least(name, worst, -_LOSS_DB, "dB"))
    return rows
