"""The open area of the pupil's footprint on the panel, computed exactly rather than sampled.

The footprint is the ellipse ``centre + shape @ u`` over the unit disc of u. Its part over open rows is a sum of
segments of the disc, in closed form. The part behind opaque columns is subtracted. Columns are thin strips, crossed by
chords along Y: the open length of a chord is the difference of two values of the rows' antiderivative, and Gauss's rule
sums over chords. With x = sin(angle) the integrand is smooth up to the ends of the ellipse.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.simulation.panel import column_open_interval, pupil_footprint, row_open_interval
from udccal.simulation.truth import RigTruth

_CHORDS = np.polynomial.legendre.leggauss(8)


def converging_footprint(
    truth: RigTruth, directions: Float[np.ndarray, "n 3"], depth_mm: float = 0.0
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Intersect the beam that a pixel receives with a plane ``depth_mm`` in front of the panel (z = depth).

    The beam is as wide as the pupil at the pupil, and converges to a point at the focus distance.

    Returns:
        (centre, shape) in mm: the ellipse ``centre + shape @ u`` over the unit disc of u.
    """
    centre, shape = pupil_footprint(truth, directions)
    distance = depth_mm - float(truth.optics.pupil_mm[2])
    slopes = directions[:, :2] / directions[:, 2:]
    return centre + depth_mm * slopes, shape * (1 - distance / truth.optics.focus_mm)


def open_fraction(truth: RigTruth, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return the fraction of the pupil's area that rays along ``directions`` (panel axes) reach through the panel."""
    pitch = truth.panel.pitch_mm
    centre, shape = converging_footprint(truth, directions)
    slopes = directions[:, :2] / directions[:, 2:]
    rows = row_open_interval(truth, slopes[:, 1])
    column_start, column_width = column_open_interval(truth, slopes[:, 0])
    columns_opaque = (column_start + column_width, 1 - column_width)
    centre, shape = centre / pitch, shape / pitch
    area = _disc_in_strips(centre[:, 1], np.linalg.norm(shape[:, 1], axis=-1), rows)
    return (area - _disc_in_crossings(centre, shape, rows, columns_opaque)) / np.pi


def _disc_in_strips(
    centre: Float[np.ndarray, "n"],
    half: Float[np.ndarray, "n"],
    strips: tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]],
) -> Float[np.ndarray, "n"]:
    """Return the area of the unit disc over periodic strips; it spans ``centre`` +- ``half`` of their coordinate."""
    start, width = strips
    first = np.floor(centre - half - start)
    area = np.zeros_like(centre)
    for i in range(_strips_touched(half)):
        low = (first + i + start - centre) / half
        area += _segment(low + width / half) - _segment(low)
    return area


def _segment(edge: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the area of the part of the unit disc below ``edge``, less pi / 2."""
    edge = np.clip(edge, -1.0, 1.0)
    return edge * np.sqrt(1 - edge * edge) + np.arcsin(edge)


def _disc_in_crossings(
    centre: Float[np.ndarray, "n 2"],
    shape: Float[np.ndarray, "n 2 2"],
    rows: tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]],
    columns: tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]],
) -> Float[np.ndarray, "n"]:
    """Return the area of the unit disc over both ``rows`` and ``columns``; ``columns`` are narrow."""
    half = np.linalg.norm(shape[:, 0], axis=-1)
    along = shape[:, 0] / half[:, None]
    # On the chord sin(angle) of the disc: Y = centre + slant sin(angle) +- reach cos(angle).
    slant = shape[:, 1, 0] * along[:, 0] + shape[:, 1, 1] * along[:, 1]
    reach = np.abs(shape[:, 1, 1] * along[:, 0] - shape[:, 1, 0] * along[:, 1])
    start, width = columns
    first = np.floor(centre[:, 0] - half - start)
    area = np.zeros_like(half)
    for j in range(_strips_touched(half)):
        low = (first + j + start - centre[:, 0]) / half
        begin, end = (np.arcsin(np.clip(edge, -1.0, 1.0)) for edge in (low, low + width / half))
        middle, span = (begin + end) / 2, (end - begin) / 2
        for node, weight in zip(*_CHORDS, strict=True):
            sine = np.sin(middle + node * span)
            cosine = np.sqrt(1.0 - sine * sine)
            y = centre[:, 1] + slant * sine
            reached = reach * cosine
            length = _open_length(y + reached, rows) - _open_length(y - reached, rows)
            area += weight * span * cosine * length / reach
    return area


def _open_length(
    y: Float[np.ndarray, "n"], strips: tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]
) -> Float[np.ndarray, "n"]:
    """Return the antiderivative of the periodic mask that is 1 on the strips."""
    start, width = strips
    position = y - start
    period = np.floor(position)
    return period * width + np.minimum(position - period, width)


def _strips_touched(half: Float[np.ndarray, "n"]) -> int:
    return int(np.ceil(2 * float(half.max()))) + 1
