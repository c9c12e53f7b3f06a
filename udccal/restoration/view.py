"""The view that restoration delivers: the largest upright picture, parallel to the panel, that the sensor fills."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Bool, Float, Float64

from udccal.errors import RestorationError
from udccal.models.geometry import Geometry, VirtualView, panel_directions, project_directions
from udccal.numerics import in_float64
from udccal.restoration.prepared import kept
from udccal.rig import RigDescription

_BORDER_POINTS = 48
_CENTRES = 15
_REFINEMENTS = 4
_BISECTIONS = 24

_project, _directions = jax.jit(project_directions), jax.jit(panel_directions)


@dataclass(frozen=True)
class _Pinhole:
    """A view's numbers, as they are kept."""

    focal_px: Float64[np.ndarray, ""]
    principal_point_px: Float64[np.ndarray, "2"]


def kept_view(geometry: Geometry, rig: RigDescription, keep: Path | None) -> VirtualView:
    """Return ``inscribed_view`` for the rig's sizes, kept in a folder; None keeps nothing."""
    camera, wanted = rig.camera, rig.view

    def find() -> _Pinhole:
        view = inscribed_view(geometry, camera.columns, camera.rows, wanted.columns, wanted.rows)
        return _Pinhole(np.asarray(view.focal_px, np.float64), np.asarray(view.principal_point_px, np.float64))

    pinhole = kept(keep, _Pinhole, (geometry, camera, wanted), find)
    return VirtualView(wanted.columns, wanted.rows, float(pinhole.focal_px), pinhole.principal_point_px)


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
