"""Figures about how good a fit is: what it left over, and what more captures would bring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from udccal.reports.figures import bare, row_of_axes
from udccal.reports.residuals import ResidualHistogram, ResidualMap

_BLUE, _RED = "#2f6fb5", "#c0392b"


@dataclass(frozen=True)
class TradeCurve:
    """How sure a quantity is against how much is captured; ``now`` counts what was captured.

    Attributes:
        knob: what is counted, such as ``flats``.
        quantity: what becomes surer, with its unit in brackets.
    """

    knob: str
    quantity: str
    counts: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    now: float


def residual_figure(cells: ResidualMap, histogram: ResidualHistogram) -> Figure:
    """Left: where on the sensor residuals are one-sided. Right: their distribution beside the normal one."""
    figure, (left, right) = row_of_axes(2, 6.8, 2.9)
    left.set_facecolor("0.85")
    image = left.imshow(cells.mean_sigma, cmap="RdBu_r", vmin=-4, vmax=4, aspect="auto", interpolation="nearest")
    bare(left, "mean residual of each part of the sensor")
    figure.colorbar(image, ax=left, shrink=0.8, label="σ")
    width = float(histogram.edges[1] - histogram.edges[0])
    centres = histogram.edges[:-1] + width / 2
    total = max(int(histogram.counts.sum()), 1)
    right.bar(centres, histogram.counts / total / width, width=width, color=_BLUE, alpha=0.6, label="residuals")
    right.plot(centres, np.exp(-0.5 * centres**2) / np.sqrt(2 * np.pi), "k-", lw=1, label="noise alone")
    right.set(xlabel="residual [σ]", yticks=[])
    right.set_title(
        f"mean {histogram.mean:+.2f}, spread {histogram.std:.2f}, {histogram.outside} beyond 5 σ", fontsize=9
    )
    right.legend(frameon=False, fontsize=8)
    return figure


def trade_figure(curves: tuple[TradeCurve, ...]) -> Figure:
    """One panel per knob: sigma against the number captured, with what was captured marked."""
    figure, panels = row_of_axes(len(curves), 3.4 * len(curves), 2.7)
    for axes, curve in zip(panels, curves, strict=True):
        axes.loglog(curve.counts, curve.sigma, "-", color=_BLUE, lw=1.5)
        at = float(np.exp(np.interp(np.log(curve.now), np.log(curve.counts), np.log(curve.sigma))))
        axes.plot([curve.now], [at], "o", color=_RED, ms=6, label=f"captured: {curve.now:g}")
        axes.set_xlabel(curve.knob)
        axes.set_ylabel(curve.quantity, fontsize=8)
        axes.legend(frameon=False, fontsize=8)
        axes.grid(alpha=0.25, which="both")
    return figure
