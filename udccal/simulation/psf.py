"""The simulated point-spread function: diffraction by the panel, integrated by square pixels through a distorting lens.

A kernel belongs to its source. Sample [j, i] is the response of the pixel whose centre lies (i - columns // 2,
j - rows // 2) pixels from ``position``; the source's image is at ``position`` + ``source_offset_px``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.errors import UdccalError
from udccal.simulation.rays import cosine_grid
from udccal.simulation.spread import AngularSpread, angular_spread, averaged_over
from udccal.simulation.truth import RigTruth, pixels_to_directions

_HALF_PERIODS = ((0.0, 0.0), (0.5, 0.5))


@dataclass(frozen=True)
class _Care:
    """Fineness of a pixel's integration.

    Attributes:
        grid_px: (x, y) steps of the grid on which the light of a wide source is averaged over it.
        steps: least number of steps along the pixel's slanted edges. step_px: largest width of a step.
    """

    grid_px: tuple[float, float]
    steps: int
    step_px: float


# Nearly all light falls close to the source, most of the rest on two thin streaks across it.
_CORE, _ELSEWHERE = _Care((1 / 32, 1 / 32), 4, 0.03), _Care((1 / 4, 1 / 4), 1, 0.2)
_ROW_STREAK, _COLUMN_STREAK = _Care((1 / 8, 1 / 32), 2, 0.06), _Care((1 / 32, 1 / 8), 2, 0.06)
_STREAK_HALF_WIDTH_PX = 6.0
# One diffraction pattern serves sources no farther apart than this.
SHARED_PX = 4.0


def kernels(
    truth: RigTruth,
    positions_px: Float[np.ndarray, "n 2"],
    rows: int,
    columns: int,
    source_offset_px: tuple[float, float] = (0.0, 0.0),
    source_disc_px: float = 0.0,
) -> Float[np.ndarray, "n 3 rows columns"]:
    """Return kernels of sources at ``positions_px`` + ``source_offset_px``; each colour sums to 1.

    Args:
        truth: the simulated rig.
        positions_px: (x, y) of the middle sample of each kernel; any sub-pixel value.
        rows: odd number of rows. columns: odd number of columns.
        source_offset_px: (x, y) of the source's image from the middle sample's centre.
        source_disc_px: diameter of the source's image; 0 for a point.
    """
    light = [
        captured_light(truth, position, rows, columns, source_offset_px, source_disc_px) for position in positions_px
    ]
    return np.stack([k / k.sum(axis=(1, 2), keepdims=True) for k in light])


def phase_averaged_kernels(
    truth: RigTruth, positions_px: Float[np.ndarray, "n 2"], rows: int, columns: int
) -> Float[np.ndarray, "n 3 rows columns"]:
    """Return kernels averaged over the mask and the mask moved by half a period.

    A kernel changes by about a percent as the footprint slides over one row, which a grid of positions cannot follow.
    The average varies as slowly as the geometry.
    """
    light = [captured_light(truth, position, rows, columns, shifts=_HALF_PERIODS) for position in positions_px]
    return np.stack([k / k.sum(axis=(1, 2), keepdims=True) for k in light])


def captured_light(
    truth: RigTruth,
    position_px: Float[np.ndarray, "2"],
    rows: int,
    columns: int,
    source_offset_px: tuple[float, float] = (0.0, 0.0),
    source_disc_px: float = 0.0,
    shifts: tuple[tuple[float, float], ...] = ((0.0, 0.0),),
    spread: AngularSpread | None = None,
) -> Float[np.ndarray, "3 rows columns"]:
    """Return one kernel before normalisation: fractions of all the light that passes the panel towards the lens.

    ``shifts`` moves the mask by fractions of (a column, a row) and averages over them. ``spread`` is a result of
    ``spread_at`` for a source at most ``SHARED_PX`` away; it saves most of the work for several sources side by side.

    Raises:
        UdccalError: when ``rows`` or ``columns`` is even.
    """
    if rows % 2 == 0 or columns % 2 == 0:
        raise UdccalError(f"Expected odd kernel rows and columns, found {rows} and {columns}. Add one to what is even.")
    source = position_px + np.asarray(source_offset_px)
    direction = pixels_to_directions(truth.optics, source)
    corners = cosine_grid(
        truth,
        position_px[0] + np.arange(columns + 1) - columns // 2 - 0.5,
        position_px[1] + np.arange(rows + 1) - rows // 2 - 0.5,
    )
    offsets = corners - direction[:2]
    spread = spread or _spread_over(truth, direction, offsets, shifts)
    light = np.empty((rows, columns, 3))
    down, across = _near(truth, offsets)
    everything = slice(None)
    for window, care in (
        ((everything, everything), _ELSEWHERE),
        ((down, everything), _ROW_STREAK),
        ((everything, across), _COLUMN_STREAK),
        ((down, across), _CORE),
    ):
        corners = offsets[_corners(window)]
        if min(corners.shape[:2]) > 1:
            seen = _of_disc(truth, spread, corners, source, source_disc_px, care) if source_disc_px else spread
            light[window] = _light_in_window(seen, corners, care)
    return np.maximum(np.moveaxis(light, -1, 0), 0.0)


def spread_at(truth: RigTruth, source_px: Float[np.ndarray, "2"], reach_px: tuple[float, float]) -> AngularSpread:
    """Return the diffraction pattern of a source, out to ``reach_px`` (x, y) pixels to either side of it.

    Over a pixel or two the pattern moves with the source but changes by no more than its numerical error: the phase of
    the wire changes by about a thirtieth of a period.
    """
    around = source_px[:, None] + np.asarray(reach_px)[:, None] * np.array([-1.0, 0.0, 1.0])
    direction = pixels_to_directions(truth.optics, source_px)
    return _spread_over(truth, direction, cosine_grid(truth, around[0], around[1]) - direction[:2], ((0.0, 0.0),))


def _spread_over(
    truth: RigTruth,
    direction: Float[np.ndarray, "3"],
    offsets: Float[np.ndarray, "corner_rows corner_columns 2"],
    shifts: tuple[tuple[float, float], ...],
) -> AngularSpread:
    reach = np.abs(offsets).max(axis=(0, 1)) + SHARED_PX / truth.optics.fx_px
    return angular_spread(truth, direction, (float(reach[0]), float(reach[1])), shifts)


def _near(truth: RigTruth, offsets: Float[np.ndarray, "corner_rows corner_columns 2"]) -> tuple[slice, slice]:
    """Return the rows and columns that contain the two bent streaks through the source; none far from the source."""
    close = np.abs((offsets[:-1, :-1] + offsets[1:, 1:]) / 2) < _STREAK_HALF_WIDTH_PX / truth.optics.fx_px
    down, across = (np.flatnonzero(close[..., axis].any(axis=axis)) for axis in (1, 0))
    return (
        slice(down[0], down[-1] + 1) if down.size else slice(0, 0),
        slice(across[0], across[-1] + 1) if across.size else slice(0, 0),
    )


def _corners(window: tuple[slice, slice]) -> tuple[slice, slice]:
    """Return the slices of the corners of a window's pixels."""
    down, across = (part if part.stop is None else slice(part.start, part.stop + 1) for part in window)
    return down, across


def _of_disc(
    truth: RigTruth,
    spread: AngularSpread,
    corners: Float[np.ndarray, "corner_rows corner_columns 2"],
    source_px: Float[np.ndarray, "2"],
    diameter_px: float,
    care: _Care,
) -> AngularSpread:
    """Return the spread averaged over the source's disc, where the corners lie.

    One diffraction pattern serves all points of the disc: it moves, but does not change, over a pixel or two.
    """
    ends = source_px + diameter_px / 4 * np.array([[[1.0, 0.0], [0.0, 1.0]], [[-1.0, 0.0], [0.0, -1.0]]])
    ahead, behind = pixels_to_directions(truth.optics, ends)[..., :2]
    flat = corners.reshape(-1, 2)
    step = np.asarray(care.grid_px) / truth.optics.fx_px
    return averaged_over(spread, (ahead - behind).T, flat.min(axis=0), flat.max(axis=0), step)


def _light_in_window(
    spread: AngularSpread, corners: Float[np.ndarray, "corner_rows corner_columns 2"], care: _Care
) -> Float[np.ndarray, "rows columns 3"]:
    """Return the light in every pixel, a quadrilateral in direction cosines, by Green's theorem along its edges.

    An edge between two pixels is computed once.
    """
    steps = _steps(corners[:-1, 1:] - corners[:-1, :-1], corners[1:, 1:] - corners[:-1, 1:], care)
    along = _light_along(spread, corners[:, :-1], corners[:, 1:], steps)
    down = _light_along(spread, corners[:-1], corners[1:], steps)
    return along[:-1] + down[:, 1:] - along[1:] - down[:, :-1]


def _steps(along: Float[np.ndarray, "*n 2"], down: Float[np.ndarray, "*n 2"], care: _Care) -> int:
    """Return the number of steps of the staircases that replace pixel edges along a row and down a column."""
    along, down = (np.abs(edge).reshape(-1, 2).max(axis=0) for edge in (along, down))
    slant = max(float(along[1] / along[0]), float(down[0] / down[1]))
    return max(care.steps, int(np.ceil(slant / care.step_px)))


def _light_along(
    spread: AngularSpread, start: Float[np.ndarray, "*n 2"], end: Float[np.ndarray, "*n 2"], steps: int
) -> Float[np.ndarray, "*n 3"]:
    """Return an edge's contribution to the pixel on its right; the pixel on its left gets the opposite.

    Each edge is replaced by a staircase. Neighbours have the same edge, so that no light is lost or counted twice.
    """
    light = np.zeros((*start.shape[:-1], 3))
    for index in range(steps):
        low, high = (start + (end - start) * ((index + part) / steps) for part in (0, 1))
        x = (low[..., 0] + high[..., 0]) / 2
        light += spread.below(x, high[..., 1]) - spread.below(x, low[..., 1])
    return light
