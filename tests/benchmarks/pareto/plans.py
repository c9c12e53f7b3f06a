"""What the planner expects of each tier, and how well it chooses one.

The planner sees what a person's program would give it: the frame, the panel's picture and a budget. Its choice is held
against the tier that was best among those whose measured median time keeps the budget.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from tests.benchmarks.pareto.groups import COMPARED
from tests.benchmarks.pareto.runs import Run, Sight, median_ms
from tests.benchmarks.rows import Row, at_most
from udccal.errors import RestorationError
from udccal.profiles.profile import Profile
from udccal.restoration.planner import planned
from udccal.restoration.scene_plan import Wish
from udccal.restoration.stages import chosen_stages
from udccal.tiers import Tier

# The last one is all that the slowest tier may take.
BUDGETS_MS: Final = (40.0, 200.0, 500.0, 20_000.0)
_REGRET_DB, _ERROR_DB, _ERROR_PERCENT = 0.3, 0.5, 25.0


@dataclass(frozen=True)
class Choice:
    """The tier that the planner chose for a scene under a budget; None where it refused."""

    scene: str
    budget_ms: float
    tier: Tier | None


@dataclass(frozen=True)
class Expected:
    """What the planner expected of a tier on a scene."""

    scene: str
    tier: Tier
    dB: float
    ms: float


@dataclass(frozen=True)
class Plans:
    """All that the planner said."""

    choices: tuple[Choice, ...]
    expected: tuple[Expected, ...]


def plans_of(profile: Profile, sights: Iterable[Sight], keep: Path) -> Plans:
    """Ask the planner about every sight of the compared groups.

    Args:
        profile: the rig as measured.
        sights: what the camera took.
        keep: folder of prepared arrays, and of the times of this computer.
    """
    choices, expected = list[Choice](), list[Expected]()
    for sight in sights:
        if sight.case.group not in COMPARED:
            continue
        name, taken = sight.case.shot.name, sight.taken
        given = profile, taken.frame, taken.exposure_s, taken.panel_picture
        stages = chosen_stages(*given)
        for budget_ms in BUDGETS_MS:
            try:
                tier = planned(*given, Wish(budget_ms=budget_ms), stages, keep=keep).tier
            except RestorationError:
                tier = None
            choices.append(Choice(name, budget_ms, tier))
        for each in planned(*given, Wish(), stages, forecast=True, keep=keep).tiers:
            dB = float("nan") if each.psnr_dB is None else each.psnr_dB
            expected.append(Expected(name, each.tier, dB, each.frame_ms))
    return Plans(tuple(choices), tuple(expected))


def regret_dB(choice: Choice, runs: Mapping[Tier, Run], ms: Mapping[Tier, float]) -> float:
    """dB of the best tier that keeps the budget, less those of the chosen one; at least 0.

    A plan that refuses where some tier keeps the budget leaves the picture as it was before. Where none keeps it, to
    refuse is right.

    Args:
        choice: of the planner.
        runs: of the same scene.
        ms: measured median time of a frame at each tier.
    """
    within = [run.after_dB for tier, run in runs.items() if ms[tier] <= choice.budget_ms]
    if not within:
        return 0.0
    found = next(iter(runs.values())).before_dB if choice.tier is None else runs[choice.tier].after_dB
    return max(max(within) - found, 0.0)


def choice_rows(plans: Plans, runs: Sequence[Run]) -> list[Row]:
    """Mean regret at each budget, and by how much the chosen tier's measured time exceeds a budget at most."""
    ms = {tier: median_ms(runs, tier) for tier in Tier}
    rows, excess = [], [0.0]
    for budget_ms in BUDGETS_MS:
        own = [choice for choice in plans.choices if choice.budget_ms == budget_ms]
        regrets = [regret_dB(choice, _of_scene(runs, choice.scene), ms) for choice in own]
        rows.append(at_most(f"auto regret, {budget_ms:g} ms", float(np.mean(regrets)), _REGRET_DB, "dB"))
        excess += [100 * (ms[choice.tier] / budget_ms - 1) for choice in own if choice.tier is not None]
    return [*rows, at_most("auto: time beyond a budget, worst", max(excess), _ERROR_PERCENT, "%")]


def error_rows(plans: Plans, runs: Sequence[Run]) -> list[Row]:
    """Expected less measured: PSNR (RMS over scenes) and time (of the median) of each tier."""
    rows = []
    for tier in Tier:
        own = [each for each in plans.expected if each.tier is tier]
        for group in COMPARED:
            measured = {run.scene: run.after_dB for run in runs if run.tier is tier and run.group is group}
            errors = [each.dB - measured[each.scene] for each in own if each.scene in measured]
            rms = float(np.sqrt(np.mean(np.square(errors))))
            rows.append(at_most(f"plan error dB, {tier}, {group}", rms, _ERROR_DB, "dB"))
    for tier in Tier:
        expected_ms = float(np.median([each.ms for each in plans.expected if each.tier is tier]))
        error = abs(expected_ms / median_ms(runs, tier) - 1)
        rows.append(at_most(f"plan error ms, {tier}", 100 * error, _ERROR_PERCENT, "%"))
    return rows


def bias_dB(plans: Plans, runs: Sequence[Run], tier: Tier) -> float:
    """Mean of expected less measured PSNR of a tier over the scenes of the compared groups."""
    measured = {run.scene: run.after_dB for run in runs if run.tier is tier and run.group in COMPARED}
    return float(np.mean([each.dB - measured[each.scene] for each in plans.expected if each.tier is tier]))


def _of_scene(runs: Sequence[Run], scene: str) -> dict[Tier, Run]:
    return {run.tier: run for run in runs if run.scene == scene and run.group in COMPARED}
