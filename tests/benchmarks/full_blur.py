"""The blur of the simulator's own psf, interference included.

A kernel changes by a percent, back and forth, as the pupil's footprint slides over one row. ``build_blur`` leaves that
out: a grid of positions cannot follow it. But it is periodic in the phase psi of the rows in the footprint, which is
known everywhere, and its Fourier series over psi varies as slowly as the geometry:

    k(p) = A_0(p) + sum over h of a_h(p) cos 2 pi h psi(p) + b_h(p) sin 2 pi h psi(p).

The first three harmonics hold all but 1.5e-3 of the kernel, and all but 2e-5 of that lies within ``_CORE`` of the
source (relative L2, at full size). Columns are nearly all open: their phase changes a kernel by 1.5e-3, and is averaged
over. The tests compare the blur of single points with the simulator's kernels: 4e-3, against 1.1e-2 without
interference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.simulation.blur import SpaceVariantBlur, low_rank
from udccal.simulation.panel import pupil_footprint
from udccal.simulation.psf import captured_light
from udccal.simulation.truth import RigTruth, pixels_to_directions

# Columns and rows of the grid of kernels that benchmarks build the blur from.
BLUR_GRID = (9, 13)
_HARMONICS, _PHASES = 3, 7
_CORE = (97, 49)
_COLUMN_SHIFTS = (0.0, 0.5)
# Of the kernel and of its ripple, relative L2; the ripple is a hundredth of the kernel.
_TOLERANCE, _MOST_COMPONENTS = 1e-3, 16
_RIPPLE_TOLERANCE, _MOST_OF_RIPPLE = 0.1, 8


@dataclass(frozen=True)
class FullBlur:
    """The operator for one sensor size.

    Attributes:
        mean: averaged over phases.
        ripples: (cosine, sine) of each harmonic, in smaller windows.
    """

    truth: RigTruth
    mean: SpaceVariantBlur
    ripples: tuple[tuple[SpaceVariantBlur, SpaceVariantBlur], ...]

    @property
    def margin(self) -> tuple[int, int]:
        """As of ``SpaceVariantBlur``."""
        return self.mean.margin

    def apply(self, canvas: Float[np.ndarray, "canvas_rows canvas_columns 3"]) -> Float[np.ndarray, "rows columns 3"]:
        """As of ``SpaceVariantBlur``."""
        blurred = self.mean.convolve(canvas)
        down, across = self.ripples[0][0].margin
        top, left = self.margin[0] - down, self.margin[1] - across
        inner = canvas[top : canvas.shape[0] - top, left : canvas.shape[1] - left]
        x, y = np.arange(inner.shape[1]) - across, np.arange(inner.shape[0]) - down
        psi = row_phase(self.truth, np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64))
        for harmonic, pair in enumerate(self.ripples, start=1):
            for wave, ripple in zip((np.cos, np.sin), pair, strict=True):
                blurred += ripple.convolve(inner * wave(2 * np.pi * harmonic * psi)[..., None])
        return np.maximum(blurred, 0.0, out=blurred)


def row_phase(truth: RigTruth, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    """Place of the footprint's centre on the rows in periods; a thick row acts as a thin one at half its depth."""
    directions = pixels_to_directions(truth.optics, pixels)
    centre, _ = pupil_footprint(truth, directions)
    slope = directions[..., 1] / directions[..., 2]
    return (centre[..., 1] + slope * truth.panel.depth_mm / 2) / truth.panel.pitch_mm


def build_full_blur(truth: RigTruth, grid_columns: int, grid_rows: int, rows: int, columns: int) -> FullBlur:
    """Build the blur from kernels on a grid that spans the sensor; arguments as of ``build_blur``."""
    camera = truth.description.camera
    grid_x, grid_y = (
        np.linspace(0.0, camera.columns - 1.0, grid_columns),
        np.linspace(0.0, camera.rows - 1.0, grid_rows),
    )
    nodes = np.stack(np.meshgrid(grid_x, grid_y), axis=-1).reshape(-1, 2)
    core = min(_CORE[0], rows), min(_CORE[1], columns)
    mean = np.empty((3, len(nodes), rows, columns), np.float32)
    series = np.empty((_HARMONICS, 2, 3, len(nodes), *core), np.float32)
    for index, node in enumerate(nodes):
        mean[:, index], series[:, :, :, index] = _kernel_series(truth, node, (rows, columns), core)

    def decomposed(stack: Float[np.ndarray, "3 nodes rows columns"], most: int, tolerance: float) -> SpaceVariantBlur:
        size = stack.shape[2:]
        components, coefficients, error = low_rank(stack.reshape(3, len(nodes), -1), most, tolerance)
        shaped = components.reshape(3, -1, *size), coefficients.reshape(-1, grid_rows, grid_columns)
        return SpaceVariantBlur(*shaped, grid_x_px=grid_x, grid_y_px=grid_y, relative_error=error)

    ripples = tuple(
        (decomposed(cosine, _MOST_OF_RIPPLE, _RIPPLE_TOLERANCE), decomposed(sine, _MOST_OF_RIPPLE, _RIPPLE_TOLERANCE))
        for cosine, sine in series
    )
    return FullBlur(truth, decomposed(mean, _MOST_COMPONENTS, _TOLERANCE), ripples)


def _kernel_series(
    truth: RigTruth, node: Float[np.ndarray, "2"], size: tuple[int, int], core: tuple[int, int]
) -> tuple[Float[np.ndarray, "3 rows columns"], Float[np.ndarray, "harmonics 2 3 core_rows core_columns"]]:
    """The kernel averaged over phases, and its Fourier series over the phase of the rows."""
    here = float(row_phase(truth, node))
    mean = captured_light(truth, node, *size, shifts=((0.0, 0.0), (0.5, 0.5)))
    light = np.stack(
        [
            captured_light(truth, node, *core, shifts=tuple((c, here - k / _PHASES) for c in _COLUMN_SHIFTS))
            for k in range(_PHASES)
        ]
    )
    down, across = ((whole - part) // 2 for whole, part in zip(size, core, strict=True))
    mean[:, down : size[0] - down, across : size[1] - across] = light.mean(axis=0)
    total = mean.sum(axis=(1, 2), keepdims=True)
    harmonics = np.fft.fft(light / total, axis=0)[1 : _HARMONICS + 1] * 2 / _PHASES
    return mean / total, np.stack([harmonics.real, -harmonics.imag], axis=1)
