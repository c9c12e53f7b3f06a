"""The panel as a mask: the open part of each row and column for a ray, and the pupil's footprint.

Panel pixel (row i, column j) is centred on Y = i * pitch, X = j * pitch and reaches half a pitch to either side, so
that panel pixel coordinates follow the rule of docs/conventions.md. For a ray along the panel's normal its open part is
centred on the same point; the opaque structure (traces, emitters) lies across the edges between neighbours.

The opaque structure reaches from the panel plane (z = 0) to z = depth on the viewer's side. A ray that crosses the
panel plane at Y crosses z = depth at Y + depth * tan_y. It passes when both points lie in the same opening: the open
interval of Y is the overlap of the opening with itself moved by -depth * tan_y. Refraction is left out, because the
glass is thin compared with the distances involved.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.simulation.truth import RigTruth


def row_open_interval(
    truth: RigTruth, tan_y: Float[np.ndarray, "*n"]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Return the intervals in which rays of slope ``tan_y`` = s_y / s_z pass the rows.

    Returns:
        (start, width) in fractions of a pitch: open for Y / pitch in [i + start, i + start + width], i an integer.
        ``start`` lies near -row_open / 2; ``width`` is never negative.
    """
    return _open_interval(truth.panel.row_open, truth.panel.depth_mm / truth.panel.pitch_mm, tan_y)


def column_open_interval(
    truth: RigTruth, tan_x: Float[np.ndarray, "*n"]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Return the intervals in which rays of slope ``tan_x`` = s_x / s_z pass the columns; see ``row_open_interval``."""
    return _open_interval(truth.panel.column_open, truth.panel.depth_mm / truth.panel.pitch_mm, tan_x)


def pupil_footprint(
    truth: RigTruth, directions: Float[np.ndarray, "*n 3"]
) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n 2 2"]]:
    """Project the entrance pupil onto the panel plane along ``directions`` (panel coordinates, s_z > 0).

    Returns:
        (centre, shape) in mm: the footprint is the ellipse ``centre + shape @ u`` over the unit disc of ``u``.
    """
    optics = truth.optics
    slopes = directions[..., :2] / directions[..., 2:]
    centre = optics.pupil_mm[:2] - optics.pupil_mm[2] * slopes
    across = optics.R_panel_camera[:, :2] * (optics.pupil_diameter_mm / 2)
    shape = across[:2] - slopes[..., :, None] * across[2]
    return centre, shape


def _open_interval(
    fraction: float, thickness: float, slope: Float[np.ndarray, "*n"]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    shift = thickness * slope
    start = -fraction / 2 - np.minimum(shift, 0.0)
    return start, np.maximum(fraction - np.abs(shift), 0.0)
