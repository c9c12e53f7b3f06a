"""Draws the maps of a comparison of two profiles."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from udccal.comparison.grid import ACROSS, DOWN
from udccal.reports.figures import bare, row_of_axes

_ARROWS = 3


def rays_figure(rays_px: Float[np.ndarray, "n 2"], shape: tuple[int, int]) -> Figure:
    """Draw the length of the rays' differences over the sensor of ``shape`` (rows, columns), and their directions."""
    figure, (axis,) = row_of_axes(1, 5.2, 3.8)
    rays, (rows, columns) = rays_px.reshape(DOWN, ACROSS, 2), shape
    length = np.hypot(rays[..., 0], rays[..., 1])
    edges = (-0.5, columns - 0.5, rows - 0.5, -0.5)
    image = axis.imshow(length, extent=edges, interpolation="bilinear", cmap="viridis", vmin=0.0, vmax=_reach(length))
    some = np.s_[1::_ARROWS, 1::_ARROWS]
    x, y = np.meshgrid(np.linspace(0, columns - 1, ACROSS), np.linspace(0, rows - 1, DOWN))
    scale = _reach(length) * ACROSS / _ARROWS / columns
    u, v = rays[..., 0][some], rays[..., 1][some]
    axis.quiver(x[some], y[some], u, v, angles="xy", scale_units="xy", scale=scale, color="w", width=0.004)
    bare(axis, "rays, B against A")
    figure.colorbar(image, ax=axis, shrink=0.8, label="px")
    return figure


def wire_difference_figure(wire: Float[np.ndarray, "rows columns"]) -> Figure:
    """Draw the difference of the wire maps in percent; ``wire`` is the logarithm of their quotient."""
    figure, (axis,) = row_of_axes(1, 5.2, 3.8)
    percent = 100 * np.expm1(wire)
    reach = _reach(np.abs(percent))
    image = axis.imshow(percent, cmap="RdBu_r", vmin=-reach, vmax=reach)
    bare(axis, "wire map, B against A")
    figure.colorbar(image, ax=axis, shrink=0.8, label="%")
    return figure


def _reach(values: Float[np.ndarray, "rows columns"]) -> float:
    """End of a colour scale: nearly the largest value; 1 where there is no difference to show."""
    return float(np.percentile(values, 99.5)) or 1.0
