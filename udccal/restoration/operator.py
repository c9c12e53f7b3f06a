"""The space-varying blur of one channel as a linear operator with its adjoint, by FFTs on a padded canvas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex64, Float32
from scipy import fft

from udccal.restoration.lowrank import LowRank, coefficient_map


@dataclass(frozen=True)
class Canvas:
    """A picture larger than the frame, which holds the scene just outside the frame too.

    The frame starts at (``top``, ``left``). The canvas is periodic: opposite edges are neighbours.
    """

    rows: int
    columns: int
    top: int
    left: int
    frame_rows: int
    frame_columns: int
    workers: int

    @classmethod
    def around(cls, frame_rows: int, frame_columns: int, pad_rows: int, pad_columns: int, workers: int) -> Canvas:
        """Return the smallest canvas with at least this padding on each side whose FFT is fast."""
        rows = int(fft.next_fast_len(frame_rows + 2 * pad_rows, real=True))
        columns = int(fft.next_fast_len(frame_columns + 2 * pad_columns, real=True))
        top, left = (rows - frame_rows) // 2, (columns - frame_columns) // 2
        return cls(rows, columns, top, left, frame_rows, frame_columns, workers)

    def frame(self, picture: Float32[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "frame_rows frame_columns"]:
        """Return the part of a canvas-sized picture that the sensor sees (a view, not a copy)."""
        return picture[self.top : self.top + self.frame_rows, self.left : self.left + self.frame_columns]

    def extended(self, frame: Float32[np.ndarray, "frame_rows frame_columns"]) -> Float32[np.ndarray, "rows columns"]:
        """Extend a frame over the canvas by repeating its border."""
        below = self.rows - self.frame_rows - self.top
        right = self.columns - self.frame_columns - self.left
        return np.pad(frame, ((self.top, below), (self.left, right)), mode="edge")

    def transform(self, picture: Float32[np.ndarray, "rows columns"]) -> Complex64[np.ndarray, "rows half"]:
        """Return the real FFT of a canvas-sized picture."""
        return fft.rfft2(picture, workers=self.workers)

    def inverse(self, spectrum: Complex64[np.ndarray, "rows half"]) -> Float32[np.ndarray, "rows columns"]:
        """Invert ``transform``; may overwrite its argument."""
        return fft.irfft2(spectrum, s=(self.rows, self.columns), workers=self.workers, overwrite_x=True)

    def kernel_spectrum(self, kernel: Float32[np.ndarray, "ky kx"]) -> Complex64[np.ndarray, "rows half"]:
        """Return the spectrum of a kernel whose origin is its middle sample; a larger kernel wraps around."""
        placed = np.zeros((self.rows, self.columns), dtype=np.float32)
        ky, kx = kernel.shape
        at_y = (np.arange(ky) - ky // 2) % self.rows
        at_x = (np.arange(kx) - kx // 2) % self.columns
        np.add.at(placed, (at_y[:, None], at_x[None, :]), kernel)
        return self.transform(placed)


@dataclass(frozen=True)
class Blur:
    """y = sum_r h_r * (c_r x) on a canvas: the kernel belongs to the source point."""

    canvas: Canvas
    spectra: tuple[Complex64[np.ndarray, "rows half"], ...]
    coefficients: tuple[Float32[np.ndarray, "rows columns"], ...]

    @classmethod
    def of(cls, low_rank: LowRank, canvas: Canvas) -> Blur:
        """Compute the spectra and coefficient maps of a decomposed psf."""
        x_px = np.arange(canvas.columns, dtype=np.float64) - canvas.left
        y_px = np.arange(canvas.rows, dtype=np.float64) - canvas.top
        return cls(
            canvas=canvas,
            spectra=tuple(canvas.kernel_spectrum(kernel) for kernel in low_rank.kernels),
            coefficients=tuple(coefficient_map(low_rank, r, x_px, y_px) for r in range(len(low_rank.kernels))),
        )

    def forward(self, x: Float32[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "rows columns"]:
        """Blur a canvas-sized scene."""
        total = self.spectra[0] * self.canvas.transform(self.coefficients[0] * x)
        for spectrum, coefficient in zip(self.spectra[1:], self.coefficients[1:], strict=True):
            total += spectrum * self.canvas.transform(coefficient * x)
        return self.canvas.inverse(total)

    def adjoint(self, y: Float32[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "rows columns"]:
        """Apply the transpose of ``forward``: sum_r c_r (h_r correlated with y)."""
        transformed = np.conj(self.canvas.transform(y))
        total = np.zeros_like(y)
        for spectrum, coefficient in zip(self.spectra, self.coefficients, strict=True):
            total += coefficient * self.canvas.inverse(np.conj(spectrum * transformed))
        return total

    def mean_spectrum(self) -> Complex64[np.ndarray, "rows half"]:
        """Return the spectrum of the kernel averaged over the frame."""
        total = np.zeros_like(self.spectra[0])
        for spectrum, coefficient in zip(self.spectra, self.coefficients, strict=True):
            total += spectrum * np.float32(self.canvas.frame(coefficient).mean())
        return total
