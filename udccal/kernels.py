"""The psf evaluated at field positions, compiled once for each kernel size."""

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
# Diffraction orders of green light that a kernel spans, down and across. The light beyond them is weaker than the noise
# of a well-exposed frame.
_ORDERS_DOWN, _ORDERS_ACROSS = 170.0, 44.0
_GREEN_MM = 550e-6


def kernel_size(
    rig: RigDescription, most_rows: int = KERNEL_ROWS, most_columns: int = KERNEL_COLUMNS
) -> tuple[int, int]:
    """Return the odd (rows, columns) of kernels for a rig: the extent of its orders, at most half the sensor.

    Args:
        rig: the rig description.
        most_rows: largest number of rows. most_columns: largest number of columns.
    """
    order_px = _GREEN_MM / rig.panel.pitch_mm.value * rig.lens.focal_mm.value / (1e-3 * rig.camera.pitch_um)
    rows = min(most_rows, rig.camera.rows // 2, math.ceil(_ORDERS_DOWN * order_px))
    columns = min(most_columns, rig.camera.columns // 2, math.ceil(_ORDERS_ACROSS * order_px))
    return rows - 1 + rows % 2, columns - 1 + columns % 2


def fitted_size(
    psf: PsfField, rig: RigDescription, most_rows: int = KERNEL_ROWS, most_columns: int = KERNEL_COLUMNS
) -> tuple[int, int]:
    """Return ``kernel_size`` limited to the psf's support, beyond which the captured frames showed no light.

    Args:
        psf: the psf term.
        rig: the rig description.
        most_rows: largest number of rows. most_columns: largest number of columns.
    """
    rows, columns = kernel_size(rig, most_rows, most_columns)
    across, down = (2 * int(half) + 1 for half in np.asarray(psf.support_px))
    return min(rows, down), min(columns, across)


def kernels_at(
    psf: PsfField, positions_px: Float[np.ndarray, "n 2"], rows: int, columns: int, workers: int = 2
) -> Float32[np.ndarray, "n 3 rows columns"]:
    """Return kernels at positions, one call each, so that one compilation serves any number of them.

    Args:
        psf: the psf term.
        positions_px: (x, y) of the sources on the sensor.
        rows: odd number of rows. columns: odd number of columns.
        workers: threads.

    Returns:
        kernels, of which each colour sums to 1.
    """
    # A fitted term and one read from a file hold the same numbers in different types: one compilation serves both.
    psf = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), psf)

    @in_float64
    def one(position: Float[np.ndarray, "2"]) -> Float32[np.ndarray, "3 rows columns"]:
        return np.asarray(psf_kernels(psf, position[None], rows, columns), dtype=np.float32)[0]

    first = one(positions_px[0])
    with ThreadPoolExecutor(workers) as pool:
        return np.stack([first, *pool.map(one, positions_px[1:])])
