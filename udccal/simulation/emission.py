"""The fraction of each emitter's light that a sensor pixel collects, from the plane of the emitters.

A panel pixel has one emitter per primary, side by side in the opaque strip below its opening. The fraction of an
emitter's light that reaches a sensor pixel is the part of the emitter inside the pupil's (defocused) footprint. The
fractions depend on the rig alone, so they are computed once for any number of pictures.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32
from scipy import sparse

from udccal.simulation.footprint import converging_footprint
from udccal.simulation.truth import RigTruth

EMITTER_COLUMN_OFFSETS = (-0.3, 0.0, 0.3)
EMITTER_ROW_OFFSET = 0.5
_EMITTER_WIDTH = 0.22
_HEIGHT_IN_STRIP = 0.5
_CHORDS = np.polynomial.legendre.leggauss(6)
# Their arrays fit into a processor's cache.
_RAYS_AT_ONCE = 4096


def emitter_shares(
    truth: RigTruth,
    directions: Float[np.ndarray, "n 3"],
    depth_mm: float,
    weight: Float[np.ndarray, "n"],
    primary: int,
) -> sparse.csr_array:
    """Return the matrix from the light of one primary (panel pixels, row-major) to the light that rays receive.

    Args:
        truth: the simulated rig.
        directions: directions of the rays in panel coordinates.
        depth_mm: z of the plane in which the emitters (or their mirror image) appear.
        weight: factor per ray; an evenly lit panel gives ``weight`` to within the ripple of the rows.
        primary: index of the emitter.
    """
    pitch = truth.panel.pitch_mm
    centre, shape = (array / pitch for array in converging_footprint(truth, directions, depth_mm))
    parts = []
    for first in range(0, len(weight), _RAYS_AT_ONCE):
        rays = slice(first, first + _RAYS_AT_ONCE)
        parts.append(_shares(truth, centre[rays], shape[rays], weight[rays], primary))
    return sparse.csr_array(sparse.vstack(parts, format="csr"))


def _shares(
    truth: RigTruth,
    centre: Float[np.ndarray, "n 2"],
    shape: Float[np.ndarray, "n 2 2"],
    weight: Float[np.ndarray, "n"],
    primary: int,
) -> sparse.csr_array:
    """Return ``emitter_shares`` of some rays."""
    height = _HEIGHT_IN_STRIP * (1 - truth.panel.row_open)
    half = np.linalg.norm(shape, axis=-1)
    low = centre - half
    # Emitters lie at most so far from the middle of their column, and as high, that these many may be touched.
    reach = np.array([max(EMITTER_COLUMN_OFFSETS) + _EMITTER_WIDTH / 2, height])
    columns_touched, rows_touched = (int(most) for most in np.ceil(2 * half.max(axis=0) + reach) + 1)
    first_row = np.floor(low[:, 1] - EMITTER_ROW_OFFSET).astype(np.int64)
    first_column = np.floor(low[:, 0]).astype(np.int64)
    columns = first_column[:, None] + np.arange(columns_touched)
    # Boxes are counted from each ray's first column: single precision is then enough, and takes half the time.
    left = np.arange(columns_touched) + EMITTER_COLUMN_OFFSETS[primary] - _EMITTER_WIDTH / 2
    centre = centre - np.stack([first_column, np.zeros_like(first_column)], axis=-1)
    scale = (weight / (np.pi * height * _EMITTER_WIDTH))[:, None]
    shares, pixels = [], []
    for i in range(rows_touched):
        row = first_row + i
        top = row + EMITTER_ROW_OFFSET - height / 2
        shares.append(scale * _disc_in_boxes(centre, shape, top, height, left))
        pixels.append(_flat_indices(truth, row[:, None], columns))
    return _matrix(truth, np.concatenate(shares, axis=1), np.concatenate(pixels, axis=1))


def _disc_in_boxes(
    centre: Float[np.ndarray, "n 2"],
    shape: Float[np.ndarray, "n 2 2"],
    top: Float[np.ndarray, "n"],
    height: float,
    left: Float[np.ndarray, " boxes"],
) -> Float32[np.ndarray, "n boxes"]:
    """Return the area of the unit disc over one row of boxes: chords along X, summed by Gauss's rule over the row."""
    half = np.linalg.norm(shape[:, 1], axis=-1)
    along = shape[:, 1] / half[:, None]
    slant = shape[:, 0, 0] * along[:, 0] + shape[:, 0, 1] * along[:, 1]
    reach = np.abs(shape[:, 0, 1] * along[:, 0] - shape[:, 0, 0] * along[:, 1])
    low = (top - centre[:, 1]) / half
    begin, end = (np.arcsin(np.clip(edge, -1.0, 1.0)) for edge in (low, low + height / half))
    middle, span = (begin + end) / 2, (end - begin) / 2
    left, right = left.astype(np.float32), (left + _EMITTER_WIDTH).astype(np.float32)
    area = np.zeros((half.size, left.size), np.float32)
    for node, weight in zip(*_CHORDS, strict=True):
        angle = middle + node * span
        cosine = np.cos(angle)
        x = centre[:, 0] + slant * np.sin(angle)
        begin_x, end_x = ((x + way * reach * cosine).astype(np.float32)[:, None] for way in (-1, 1))
        length = np.minimum(end_x, right) - np.maximum(begin_x, left)
        np.maximum(length, 0.0, out=length)
        length *= (weight * span * cosine / reach).astype(np.float32)[:, None]
        area += length
    return area


def _flat_indices(truth: RigTruth, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the index of each panel pixel in a row-major picture; -1 outside the panel."""
    panel = truth.description.panel
    inside = (rows >= 0) & (rows < panel.rows) & (columns >= 0) & (columns < panel.columns)
    return np.where(inside, rows * panel.columns + columns, -1)


def _matrix(truth: RigTruth, shares: np.ndarray, pixels: np.ndarray) -> sparse.csr_array:
    panel = truth.description.panel
    used = (shares > 0) & (pixels >= 0)
    ends = np.concatenate([[0], np.cumsum(used.sum(axis=1))])
    return sparse.csr_array(
        (shares[used].astype(np.float32), pixels[used].astype(np.int32), ends.astype(np.int32)),
        shape=(len(shares), panel.rows * panel.columns),
    )
