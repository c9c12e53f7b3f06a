"""Figures of the quality of a fit: its residuals, and the effect of more captures."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from udccal.planning.forecast import Curve, Forecast
from udccal.reports.figures import bare, row_of_axes
from udccal.reports.residuals import ResidualHistogram, ResidualMap

_BLUE, _RED = "#2f6fb5", "#c0392b"
# The floor is drawn where it is near enough to be seen; axes end this factor beyond the curves.
_NEAR, _ROOM, _TICKS = 0.5, 1.08, 4


def residual_figure(cells: ResidualMap, histogram: ResidualHistogram) -> Figure:
    """Draw the mean residuals over the sensor (left), and their distribution with the normal one (right)."""
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


def forecast_figure(ahead: Forecast) -> Figure:
    """Draw sigma against each number of the captures, one panel each, with the captured number and the floor."""
    curves = ahead.curves
    # One panel alone is as large as two, so that its labels have room.
    figure, panels = row_of_axes(len(curves), max(3.0 * len(curves), 4.2), 2.7)
    low = min(float(curve.sigma.min()) for curve in curves)
    high = max(float(curve.sigma.max()) for curve in curves)
    low = min(low, ahead.limits.floor) if ahead.limits.floor > _NEAR * low else low
    for axes, curve in zip(panels, curves, strict=True):
        axes.loglog(curve.counts, curve.sigma, "-", color=_BLUE, lw=1.8)
        axes.plot([curve.now], [ahead.sigma], "o", color=_RED, ms=6, label=f"captured: {curve.now}")
        if low <= ahead.limits.floor:
            axes.axhline(ahead.limits.floor, color="0.4", ls="--", lw=1, label="floor")
        axes.set(xlabel=curve.variable.counted, ylim=(low / _ROOM, high * _ROOM))
        _plain_ticks(axes, curve)
        axes.legend(frameon=False, fontsize=7.5, loc="upper right")
        axes.grid(alpha=0.25, which="both")
    panels[0].set_ylabel(f"σ [{ahead.quantity.unit}]")
    return figure


def _plain_ticks(axes: Axes, curve: Curve) -> None:
    """Label counts as plain numbers, and sigma without powers of ten."""
    lowest, highest = float(curve.counts[0]), float(curve.counts[-1])
    places = np.unique(np.rint(np.geomspace(lowest, highest, _TICKS)).astype(int))
    axes.xaxis.set_major_locator(FixedLocator([float(place) for place in places]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.tick_params(labelsize=8)
