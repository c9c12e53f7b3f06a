"""``pareto.svg``: dB over time, one curve through the tiers per group."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tests.benchmarks.pareto.groups import Group
from tests.benchmarks.pareto.runs import Clear, Run, mean_dB, of_group
from udccal.tiers import Tier

# Told apart by colour and by marker (Okabe and Ito's palette, which colour-blind people can read).
_STYLE: Final = {
    Group.nineteen: ("#0072B2", "o"),
    Group.fine: ("#D55E00", "s"),
    Group.lamps: ("#B88A00", "^"),
    Group.dark: ("#444444", "D"),
    Group.panel: ("#009E73", "v"),
}


def draw(runs: Sequence[Run], clear: Iterable[Clear], title: str, path: Path) -> None:
    """Draw the curves; a dashed line is what a camera without a panel reaches.

    Args:
        runs: of every tier.
        clear: of the groups that have it.
        title: names the rig.
        path: the file.
    """
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    for group in Group:
        if any(run.group is group for run in runs):
            _curve(axes, runs, group)
    clear = list(clear)
    for group in {each.group for each in clear}:
        value, colour = float(np.mean([each.dB for each in clear if each.group is group])), _STYLE[group][0]
        axes.axhline(value, color=colour, linestyle=(0, (5, 3)), linewidth=1.2)
        axes.annotate(
            f"{group}: a camera without a panel",
            (0.01, value),
            (0, 3),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            color=colour,
            fontsize=9,
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("median time of a frame in ms, from raw to 8 bits")
    axes.set_ylabel("mean PSNR in dB")
    axes.set_title(title, fontsize=11)
    axes.grid(which="major", color="#dddddd", linewidth=0.6)
    axes.margins(x=0.12, y=0.08)
    axes.legend(title="group (pictures)", loc="lower right", framealpha=1.0)
    figure.savefig(path, metadata={"Date": None})


def _curve(axes: Axes, runs: Sequence[Run], group: Group) -> None:
    own = {tier: of_group(runs, group, tier) for tier in Tier}
    ms, dB = (
        [float(np.median([run.ms for run in each])) for each in own.values()],
        [mean_dB(each) for each in own.values()],
    )
    colour, marker = _STYLE[group]
    cases = len(own[Tier.preview])
    axes.plot(ms, dB, color=colour, marker=marker, markersize=6, linewidth=1.8, label=f"{group} ({cases})")
    if group is Group.nineteen:
        for tier, x, y in zip(Tier, ms, dB, strict=True):
            aside = "right" if tier is Tier.preview else "center"
            axes.annotate(tier, (x, y), (0, 9), textcoords="offset points", ha=aside, fontsize=10, color=colour)
