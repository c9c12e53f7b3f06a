"""The tables of docs/restoration.md and of README.md."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tests.benchmarks.pareto.deconvolution import Deconvolutions, deconv_table
from tests.benchmarks.pareto.groups import COMPARED, Group
from tests.benchmarks.pareto.instead import Peer, peer_table
from tests.benchmarks.pareto.plans import BUDGETS_MS, Plans, bias_dB
from tests.benchmarks.pareto.precision import LEAST_DB, Loss, cheapest
from tests.benchmarks.pareto.runs import Clear, Run, mean_dB, of_group
from tests.benchmarks.rows import Row, table
from udccal.tiers import Tier

_SAID = {
    Group.nineteen: "photographs, HDR pictures and views of panoramas",
    Group.fine: "detail to the pixel",
    Group.lamps: "lamps in view",
    Group.dark: "light / 8 and / 64",
    Group.panel: "panel from black to white, and faces",
}


@dataclass(frozen=True)
class Measured:
    """All that the tables tell."""

    runs: Sequence[Run]
    clear: Sequence[Clear]
    ready_s: Mapping[Tier, float]
    plans: Plans
    losses: Sequence[Loss]
    peers: Sequence[Peer]
    deconvolutions: Deconvolutions
    rows: Sequence[Row]


def full_table(measured: Measured) -> str:
    """For docs/restoration.md: tiers, groups, conditions, plans, precision, and what has limits."""
    scenes = len(of_group(measured.runs, Group.nineteen, Tier.preview))
    return "\n\n".join(
        (
            f"Each tier on {scenes} scenes; memory is the peak of a process that does nothing else:",
            _tiers(measured),
            "Mean dB of each group, and of a camera without a panel whose exposure fills the well as far. The error "
            "between 0.18 and 0.30 cycles/px down the columns, is its RMS in % of the true picture's:",
            groups_table(measured.runs, measured.clear),
            "The conditions of the groups dark and panel:",
            _conditions(measured.runs),
            "Tiers that `planned` chose under a budget, and expected less measured dB on average:",
            _plans(measured),
            "What rounding costs, on some scenes in which nothing clips (tables: of the filters, as they are stored):",
            precision_table(measured.losses),
            "What a user would take instead, on every fifth of the nineteen, with the best strength for these scenes:",
            peer_table(measured.peers),
            "Pictures deblurred by given kernels, the work `deconv` of [peers.md](peers.md), in linear light:",
            deconv_table(measured.deconvolutions),
            "What has a limit:",
            table(list(measured.rows)),
        )
    )


def compact_table(measured: Measured) -> str:
    """For README.md."""
    scenes = len(of_group(measured.runs, Group.nineteen, Tier.preview))
    lines = [
        f"| tier | dB, {scenes} scenes | dB, fine detail | SSIM | ms |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    usual = [run for run in measured.runs if run.group is Group.nineteen]
    before = {group: _before_dB(measured.runs, group) for group in COMPARED}
    lines.append(f"| before | {before[Group.nineteen]:.1f} | {before[Group.fine]:.1f} | | |")
    for tier in Tier:
        own = [run for run in usual if run.tier is tier]
        ssim, ms = _mean(own, lambda run: run.ssim), _median(own, lambda run: run.ms)
        fine = mean_dB(of_group(measured.runs, Group.fine, tier))
        lines.append(f"| {tier} | {mean_dB(own):.1f} | {fine:.1f} | {ssim:.3f} | {ms:.0f} |")
    clear = " | ".join(f"{clear_dB(measured.clear, group):.1f}" for group in COMPARED)
    return "\n".join([*lines, f"| no panel | {clear} | | |"])


def groups_table(runs: Sequence[Run], clear: Iterable[Clear]) -> str:
    """Mean dB of each group and tier, and the error in the band that the panel swallows."""
    clear = list(clear)
    lines = [
        f"| group | pictures | before | {' | '.join(Tier)} | no panel | error in the band, % ({', '.join(Tier)}) |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for group in Group:
        own = of_group(runs, group, Tier.preview)
        tiers = " | ".join(f"{mean_dB(of_group(runs, group, tier)):.2f}" for tier in Tier)
        last = f"{clear_dB(clear, group):.2f} | {_in_the_band(runs, group)}" if group in COMPARED else " | "
        lines.append(f"| {group}: {_SAID[group]} | {len(own)} | {_before_dB(runs, group):.2f} | {tiers} | {last} |")
    return "\n".join(lines)


def _in_the_band(runs: Iterable[Run], group: Group) -> str:
    runs = list(runs)
    return ", ".join(f"{_mean(of_group(runs, group, tier), lambda run: run.band_percent):.2f}" for tier in Tier)


def clear_dB(clear: Iterable[Clear], group: Group) -> float:
    """Mean PSNR of a camera without a panel on a group."""
    return float(np.mean([each.dB for each in clear if each.group is group]))


def precision_table(losses: Sequence[Loss]) -> str:
    """dB lost by each precision, and the cheapest that loses next to nothing."""
    lines = ["| precision | dB lost | worst scene | tables MiB |", "| --- | ---: | ---: | ---: |"]
    for loss in losses:
        lines.append(f"| {loss.name} | {np.mean(loss.dB):.3f} | {loss.worst_dB:.3f} | {loss.tables_MiB:.1f} |")
    best = cheapest(losses)
    said = f"The cheapest that loses less than {LEAST_DB:g} dB: {best.name} ({best.tables_MiB:.1f} MiB)."
    return "\n".join([*lines, "", said])


def _tiers(measured: Measured) -> str:
    lines = [
        "| tier | before dB | after dB | SSIM | FLIP | frame ms | frame CPU ms | MiB | ready s |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for tier in Tier:
        own = of_group(measured.runs, Group.nineteen, tier)
        quality = f"{_mean(own, lambda run: run.ssim):.3f} | {_mean(own, lambda run: run.flip):.3f}"
        ms, cpu_ms = _median(own, lambda run: run.ms), _median(own, lambda run: run.cpu_ms)
        cost = f"{ms:.0f} | {cpu_ms:.0f} | {max(run.peak_MiB for run in own):.0f} | {measured.ready_s[tier]:.1f}"
        before = _before_dB(measured.runs, Group.nineteen)
        lines.append(f"| {tier} | {before:.2f} | {mean_dB(own):.2f} | {quality} | {cost} |")
    return "\n".join(lines)


def _conditions(runs: Sequence[Run]) -> str:
    lines = [
        f"| condition | pictures | before | {' | '.join(Tier)} |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    own = [run for run in runs if run.group in (Group.dark, Group.panel)]
    for condition in dict.fromkeys(run.condition for run in own):
        same = [run for run in own if run.condition == condition]
        tiers = " | ".join(f"{mean_dB(run for run in same if run.tier is tier):.2f}" for tier in Tier)
        count = len([run for run in same if run.tier is Tier.preview])
        lines.append(f"| {condition} | {count} | {_mean(same, lambda run: run.before_dB):.2f} | {tiers} |")
    return "\n".join(lines)


def _plans(measured: Measured) -> str:
    said = [f"{budget:g} ms" for budget in BUDGETS_MS]
    lines = [f"| tier | {' | '.join(said)} | expected − measured dB |", f"| --- |{' ---: |' * (len(said) + 1)}"]
    for tier in (*Tier, None):
        chosen = [
            sum(choice.budget_ms == budget and choice.tier is tier for choice in measured.plans.choices)
            for budget in BUDGETS_MS
        ]
        bias = "" if tier is None else f"{bias_dB(measured.plans, measured.runs, tier):+.2f}"
        lines.append(f"| {tier or 'refused'} | {' | '.join(map(str, chosen))} | {bias} |")
    return "\n".join(lines)


def _before_dB(runs: Iterable[Run], group: Group) -> float:
    return _mean([run for run in runs if run.group is group and run.tier is Tier.preview], lambda run: run.before_dB)


def _mean(runs: Iterable[Run], of: Callable[[Run], float]) -> float:
    return float(np.mean([of(run) for run in runs]))


def _median(runs: Iterable[Run], of: Callable[[Run], float]) -> float:
    return float(np.median([of(run) for run in runs]))
