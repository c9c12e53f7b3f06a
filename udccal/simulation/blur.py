"""Space-variant blur of the simulated rig in low rank: y = sum_r h_r * (c_r x), where kernels belong to the source.

Kernels on a grid of source positions are decomposed by a singular value decomposition (Lauer, "Deconvolution with a
spatially-variant PSF", 2002), of all colours together: the coefficients c_r are common to them, the kernels h_r are
each colour's own. Between the grid's nodes the coefficients follow a cubic spline.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from jaxtyping import Float

from udccal.simulation.psf import phase_averaged_kernels
from udccal.simulation.rays import spline_basis
from udccal.simulation.truth import RigTruth

_WORKERS = 2
_MOST_COMPONENTS = 16


@dataclass(frozen=True)
class SpaceVariantBlur:
    """The operator for one sensor size.

    Attributes:
        components: kernels h_r by colour; odd sizes, origin in the middle.
        coefficients: c_r at the grid's nodes.
        grid_x_px: x of the grid's columns on the sensor. grid_y_px: y of its rows.
        relative_error: relative L2 error of the kernels on the grid, before any cut, for the worst colour.
    """

    components: Float[np.ndarray, "3 rank rows columns"]
    coefficients: Float[np.ndarray, "rank grid_rows grid_columns"]
    grid_x_px: Float[np.ndarray, "grid_columns"]
    grid_y_px: Float[np.ndarray, "grid_rows"]
    relative_error: float

    @property
    def margin(self) -> tuple[int, int]:
        """(rows, columns) of scene that must surround the sensor on every side."""
        return self.components.shape[2] // 2, self.components.shape[3] // 2

    def smaller(self, rank: int, rows: int, columns: int) -> SpaceVariantBlur:
        """Return the blur at a lower ``rank``, with the middle ``rows`` x ``columns`` pixels of its kernels at most."""
        (down, across), most = self.margin, (rows // 2, columns // 2)
        cut_rows, cut_columns = max(0, down - most[0]), max(0, across - most[1])
        inner = slice(cut_rows, 2 * down + 1 - cut_rows), slice(cut_columns, 2 * across + 1 - cut_columns)
        return replace(self, components=self.components[:, :rank, *inner], coefficients=self.coefficients[:rank])

    def apply(
        self, canvas: Float[np.ndarray, "canvas_rows canvas_columns colours"]
    ) -> Float[np.ndarray, "rows columns 3"]:
        """Blur a scene drawn on the sensor's pixels and ``margin`` around them; return the sensor's pixels.

        Pixel (margin columns, margin rows) of ``canvas`` is sensor pixel (0, 0). Light that leaves the canvas wraps
        around to its other side, but reaches only the margin, which is cut off.

        Args:
            canvas: the scene in three colours, or in one, which all colours then have.
        """
        # Next to a light a million times brighter, the cut rank and single precision give negative values.
        return np.maximum(self.convolve(canvas), 0.0)

    def convolve(
        self, canvas: Float[np.ndarray, "canvas_rows canvas_columns colours"]
    ) -> Float[np.ndarray, "rows columns 3"]:
        """Like ``apply``, for kernels that may be negative, such as a difference of two."""
        margin_rows, margin_columns = self.margin
        rows, columns = canvas.shape[0], canvas.shape[1]
        basis_y = spline_basis(self.grid_y_px, np.arange(rows, dtype=float) - margin_rows).astype(np.float32)
        basis_x = spline_basis(self.grid_x_px, np.arange(columns, dtype=float) - margin_columns).T.astype(np.float32)
        shape = (scipy.fft.next_fast_len(rows, real=True), scipy.fft.next_fast_len(columns, real=True))
        planes = np.ascontiguousarray(np.moveaxis(canvas, -1, 0), np.float32)
        total = np.zeros((3, shape[0], shape[1] // 2 + 1), np.complex64)
        for coefficients, components in zip(self.coefficients, np.moveaxis(self.components, 1, 0), strict=True):
            strength = basis_y @ coefficients.astype(np.float32) @ basis_x
            scenes = [scipy.fft.rfft2(plane * strength, s=shape, workers=_WORKERS) for plane in planes]
            for colour, component in enumerate(components):
                light = _transfer(component, shape)
                light *= scenes[colour % len(scenes)]
                total[colour] += light
        # Kernels keep their middle away from the origin, which moves the result by their margin.
        down, across = slice(2 * margin_rows, rows), slice(2 * margin_columns, columns)
        blurred = [scipy.fft.irfft2(light, s=shape, workers=_WORKERS)[down, across] for light in total]
        return np.stack(blurred, axis=-1)


def build_blur(
    truth: RigTruth,
    grid_columns: int,
    grid_rows: int,
    rows: int,
    columns: int,
    tolerance: float = 1e-3,
) -> SpaceVariantBlur:
    """Build the blur from kernels of ``rows`` x ``columns`` pixels on a grid that spans the sensor.

    Args:
        truth: the simulated rig.
        grid_columns: source positions across. grid_rows: source positions down.
        rows: odd number of rows of a kernel. columns: odd number of columns.
        tolerance: relative error of the kernels on the grid at which the rank is cut.
    """
    camera = truth.description.camera
    grid_x = np.linspace(0.0, camera.columns - 1.0, grid_columns)
    grid_y = np.linspace(0.0, camera.rows - 1.0, grid_rows)
    nodes = np.stack(np.meshgrid(grid_x, grid_y), axis=-1).reshape(-1, 2)
    stack = np.empty((3, len(nodes), rows * columns), np.float32)
    for index, kernel in enumerate(_each_kernel(truth, nodes, rows, columns)):
        stack[:, index] = kernel.reshape(3, -1)
    components, coefficients, error = low_rank(stack, _MOST_COMPONENTS, tolerance)
    return SpaceVariantBlur(
        components=components.reshape(3, -1, rows, columns),
        coefficients=coefficients.reshape(-1, grid_rows, grid_columns),
        grid_x_px=grid_x,
        grid_y_px=grid_y,
        relative_error=error,
    )


def low_rank(
    stack: Float[np.ndarray, "3 nodes samples"], max_rank: int, tolerance: float
) -> tuple[Float[np.ndarray, "3 rank samples"], Float[np.ndarray, "rank nodes"], float]:
    """Decompose ``stack[c, n]`` into the sum over r of ``coefficients[r, n] components[c, r]``.

    Returns:
        components, coefficients, and the relative error (L2, worst colour) of the rank chosen.
    """
    gram = np.einsum("cns,cms->cnm", stack, stack, optimize=True).astype(np.float64)
    # Each colour counts alike, however large its kernels' norm.
    gram /= np.trace(gram, axis1=1, axis2=2)[:, None, None]
    vectors = np.linalg.eigh(gram.sum(axis=0))[1][:, ::-1]
    kept = np.cumsum(np.einsum("nr,cnm,mr->cr", vectors, gram, vectors, optimize=True), axis=1)
    left_out = np.sqrt(np.maximum(1.0 - kept, 0.0)).max(axis=0)
    rank = int(min(np.argmax(left_out <= tolerance) + 1 if left_out[-1] <= tolerance else left_out.size, max_rank))
    coefficients = np.ascontiguousarray(vectors[:, :rank].T)
    components = (coefficients.astype(np.float32) @ stack).astype(np.float32)
    return components, coefficients, float(left_out[rank - 1])


def _each_kernel(
    truth: RigTruth, nodes: Float[np.ndarray, "n 2"], rows: int, columns: int
) -> Iterator[Float[np.ndarray, "3 rows columns"]]:
    for node in nodes:
        yield phase_averaged_kernels(truth, node[None], rows, columns)[0]


def _transfer(component: Float[np.ndarray, "rows columns"], shape: tuple[int, int]) -> np.ndarray:
    """Transform a kernel that is much smaller than ``shape``: its rows first, for which padding adds no rows."""
    rows = scipy.fft.rfft(component, n=shape[1], axis=1, workers=_WORKERS)
    return scipy.fft.fft(rows, n=shape[0], axis=0, workers=_WORKERS, overwrite_x=True)
