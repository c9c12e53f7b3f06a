"""Maps evaluated from the terms. They are stored for viewing, and so that restoration need not evaluate them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32

from udccal.cfa import cfa_named
from udccal.kernels import fitted_size, kernels_at
from udccal.models.backscatter import Backscatter, backscatter_rate
from udccal.models.psf import PsfField
from udccal.numerics import in_float64
from udccal.rig import RigDescription

ATLAS_COLUMNS, ATLAS_ROWS = 5, 3
_INSET = 0.05


@in_float64
def backscatter_mask(term: Backscatter, rig: RigDescription) -> Float32[np.ndarray, "half_rows half_columns 3"]:
    """Return the backscatter of an all-white panel in e-/s before the wire, one sample per 2 x 2 cell and channel."""
    white = np.full((rig.panel.rows, rig.panel.columns, 3), 255, dtype=np.uint8)
    mosaic = np.asarray(backscatter_rate(term, white), dtype=np.float64)
    return cfa_named(rig.camera.cfa).cell_means(mosaic).astype(np.float32)


def psf_atlas(term: PsfField, rig: RigDescription) -> Float32[np.ndarray, "places 3 ky kx"]:
    """Return kernels on a grid of field positions, row by row of positions."""
    x = np.linspace(_INSET, 1 - _INSET, ATLAS_COLUMNS) * (rig.camera.columns - 1)
    y = np.linspace(_INSET, 1 - _INSET, ATLAS_ROWS) * (rig.camera.rows - 1)
    rows, columns = fitted_size(term, rig)
    return kernels_at(term, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), rows, columns)


def tiled(atlas: Float32[np.ndarray, "places 3 ky kx"]) -> Mapping[str, Float32[np.ndarray, "rows columns"]]:
    """Return an atlas as one picture, tiled as the positions lie on the sensor; channels R, G, B."""
    rows, columns = atlas.shape[2:]
    tiles = atlas.reshape(ATLAS_ROWS, ATLAS_COLUMNS, 3, rows, columns)
    whole = tiles.transpose(2, 0, 3, 1, 4).reshape(3, ATLAS_ROWS * rows, -1)
    return dict(zip("RGB", whole, strict=True))
