"""The psf evaluated at field positions, in a way that compiles once for every use of the same kernel size."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Float, Float32

from udccal.models.psf import PsfField, psf_kernels
from udccal.numerics import in_float64
from udccal.rig import RigDescription

KERNEL_ROWS, KERNEL_COLUMNS = 257, 65
# So many diffraction orders of green light, down and across: far enough that what lies beyond is weaker than the noise
# of a well-exposed frame.
_ORDERS_DOWN, _ORDERS_ACROSS = 170.0, 44.0
_GREEN_MM = 550e-6


def kernel_size(
    rig: RigDescription, most_rows: int = KERNEL_ROWS, most_columns: int = KERNEL_COLUMNS
) -> tuple[int, int]:
    """(rows, columns) of kernels for a rig, odd: what the orders cover, no more than given or half the sensor."""
    order_px = _GREEN_MM / rig.panel.pitch_mm.value * rig.lens.focal_mm.value / (1e-3 * rig.camera.pitch_um)
    rows = min(most_rows, rig.camera.rows // 2, math.ceil(_ORDERS_DOWN * order_px))
    columns = min(most_columns, rig.camera.columns // 2, math.ceil(_ORDERS_ACROSS * order_px))
    return rows - 1 + rows % 2, columns - 1 + columns % 2


def fitted_size(
    psf: PsfField, rig: RigDescription, most_rows: int = KERNEL_ROWS, most_columns: int = KERNEL_COLUMNS
) -> tuple[int, int]:
    """As ``kernel_size``, and no more than the psf's support: where its pictures showed no light, none is undone."""
    rows, columns = kernel_size(rig, most_rows, most_columns)
    across, down = (2 * int(half) + 1 for half in np.asarray(psf.support_px))
    return min(rows, down), min(columns, across)


def kernels_at(
    psf: PsfField, positions_px: Float[np.ndarray, "n 2"], rows: int, columns: int, workers: int = 2
) -> Float32[np.ndarray, "n 3 rows columns"]:
    """Kernels at positions, one call each: the same compiled function serves any number of them, on several threads."""
    # A term just fitted and one read back hold the same numbers as different types: one compilation for both.
    psf = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), psf)

    @in_float64
    def one(position: Float[np.ndarray, "2"]) -> Float32[np.ndarray, "3 rows columns"]:
        return np.asarray(psf_kernels(psf, position[None], rows, columns), dtype=np.float32)[0]

    first = one(positions_px[0])
    with ThreadPoolExecutor(workers) as pool:
        return np.stack([first, *pool.map(one, positions_px[1:])])
