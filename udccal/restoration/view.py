"""The view that restoration delivers: the largest upright picture, parallel to the panel, that the sensor fills."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Bool, Float

from udccal.errors import RestorationError
from udccal.models.geometry import Geometry, VirtualView, panel_directions, project_directions
from udccal.numerics import in_float64

_BORDER_POINTS = 48
_CENTRES = 15
_REFINEMENTS = 4
_BISECTIONS = 24

_project, _directions = jax.jit(project_directions), jax.jit(panel_directions)


@in_float64
def inscribed_view(
    geometry: Geometry, sensor_columns: int, sensor_rows: int, columns: int, rows: int, margin: float = 0.01
) -> VirtualView:
    """Return the largest ``columns`` x ``rows`` view whose border projects inside the sensor.

    Args:
        geometry: camera geometry.
        sensor_columns: columns of the sensor. sensor_rows: rows of the sensor.
        columns: columns of the view. rows: rows of the view.
        margin: part of the sensor's size that is left free on each side.

    Raises:
        RestorationError: when no part of the sensor looks to the front of the panel.
    """
    inset = np.array([margin * sensor_columns, margin * sensor_rows])
    last = np.array([sensor_columns - 1.0, sensor_rows - 1.0])
    low, high = _slope_range(geometry, last)
    border = _unit_border() * np.array([1.0, (rows - 1) / (columns - 1)])

    def inside(centres: Float[np.ndarray, "n 2"], half_widths: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        slopes = centres[:, None] + half_widths[:, None, None] * border
        directions = np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1)
        pixels = np.asarray(_project(geometry, directions))
        return np.all((pixels >= inset) & (pixels <= last - inset), axis=(1, 2))

    centre, reach, half_width = (low + high) / 2, (high - low) / 2, 0.0
    for _ in range(_REFINEMENTS):
        steps = np.linspace(-1, 1, _CENTRES)
        centres = centre + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * reach
        widths = _largest(inside, centres, float((high - low).max()))
        best = int(np.argmax(widths))
        centre, half_width = centres[best], float(widths[best])
        reach = reach * (3.0 / _CENTRES)
    if half_width <= 0.0:
        raise RestorationError(
            "Expected the sensor to look through the panel, found no view parallel to the panel in its field. "
            "Check the geometry term."
        )
    focal_px = (columns - 1) / 2 / half_width
    middle = np.array([(columns - 1) / 2, (rows - 1) / 2])
    return VirtualView(columns=columns, rows=rows, focal_px=focal_px, principal_point_px=middle - centre * focal_px)


def _largest(inside, centres: Float[np.ndarray, "n 2"], limit: float) -> Float[np.ndarray, " n"]:  # type: ignore[no-untyped-def]
    """Return the largest half width at each centre, by bisection; 0 where not even a point fits."""
    fits, fails = np.zeros(len(centres)), np.full(len(centres), limit)
    for _ in range(_BISECTIONS):
        middle = (fits + fails) / 2
        good = inside(centres, middle)
        fits, fails = np.where(good, middle, fits), np.where(good, fails, middle)
    return np.where(inside(centres, fits), fits, 0.0)


def _unit_border() -> Float[np.ndarray, "points 2"]:
    """Return points along the border of the square from (-1, -1) to (1, 1)."""
    t = np.linspace(-1, 1, _BORDER_POINTS)
    one = np.ones_like(t)
    return np.concatenate([np.stack(side, axis=-1) for side in ((t, -one), (t, one), (-one, t), (one, t))])


def _slope_range(
    geometry: Geometry, last: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the smallest and largest slope (x/z, y/z) to the panel's normal of the sensor's border pixels."""
    pixels = (_unit_border() + 1) / 2 * last
    rays = np.asarray(_directions(geometry, pixels))
    if np.any(rays[:, 2] <= 0):
        raise RestorationError(
            "Expected every pixel to look to the front of the panel, found some that look back. "
            "Check the geometry term."
        )
    slopes = rays[:, :2] / rays[:, 2:]
    return slopes.min(axis=0), slopes.max(axis=0)
