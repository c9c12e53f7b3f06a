"""Fourier transforms of the planes of a mosaic: one plane per place of the colour pattern's cell.

Two neighbouring samples of a row are the real and the imaginary part of one number. So two planes take one complex
transform, which finds them side by side as the camera delivers them, and leaves a picture in the same way.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Complex64, Float32
from scipy import fft


def plane_spectra(
    mosaic: Float32[np.ndarray, "rows columns"], cell: tuple[int, int]
) -> Complex64[np.ndarray, "places site_rows site_half"]:
    """Return the transform of each plane, as ``rfft2`` does.

    Args:
        mosaic: whole cells.
        cell: (rows, columns) of the colour pattern.
    """
    rows, columns = mosaic.shape[0] // cell[0], mosaic.shape[1] // cell[1]
    lines = mosaic.reshape(rows, cell[0], columns, cell[1]).swapaxes(0, 1)
    if cell[1] != 2:
        return fft.rfft2(np.moveaxis(lines, 3, 1).reshape(-1, rows, columns))
    half = columns // 2 + 1
    both = np.empty((cell[0], rows, columns), dtype=np.complex64)
    for line, spectrum in zip(lines, both, strict=True):
        cv2.dft(line, dst=spectrum.view(np.float32).reshape(rows, columns, 2))
    mirrored = _conjugate_at_opposite(both, half)
    spectra = np.empty((cell[0], 2, rows, half), dtype=np.complex64)
    np.add(both[..., :half], mirrored, out=spectra[:, 0])
    np.subtract(both[..., :half], mirrored, out=spectra[:, 1])
    spectra[:, 0] *= np.float32(0.5)
    spectra[:, 1] *= np.complex64(-0.5j)
    return spectra.reshape(-1, rows, half)


def _conjugate_at_opposite(
    spectra: Complex64[np.ndarray, "lines rows columns"], half: int
) -> Complex64[np.ndarray, "lines rows half"]:
    """Return conj(spectra) at -f for the frequencies f of half spectra."""
    opposite = np.empty((*spectra.shape[:2], half), dtype=np.complex64)
    for to, of in ((slice(1), slice(1)), (slice(1, None), slice(None, 0, -1))):
        np.conjugate(spectra[:, of, :1], out=opposite[:, to, :1])
        np.conjugate(spectra[:, of, :-half:-1], out=opposite[:, to, 1:])
    return opposite


def joined_planes(
    spectra: Complex64[np.ndarray, "pictures places site_rows site_half"], cell: tuple[int, int], columns: int
) -> Float32[np.ndarray, "pictures rows columns"]:
    """Return the pictures whose planes have these transforms.

    Args:
        spectra: as ``plane_spectra`` returns them.
        cell: (rows, columns) of the colour pattern.
        columns: of the pictures.
    """
    count, _, rows, half = spectra.shape
    across = columns // cell[1]
    pictures = np.empty((count, rows, cell[0], across, cell[1]), dtype=np.float32)
    by_line = spectra.reshape(count, *cell, rows, half)
    if cell[1] != 2:
        pictures[:] = np.moveaxis(fft.irfft2(by_line, s=(rows, across)), (1, 2), (2, 4))
        return pictures.reshape(count, -1, columns)
    both = np.empty((count, cell[0], rows, across), dtype=np.complex64)
    even, turned = by_line[:, :, 0], by_line[:, :, 1] * np.complex64(1j)
    np.add(even, turned, out=both[..., :half])
    # What a whole spectrum has on its other half.
    opposite = np.subtract(even, turned, out=turned)[..., across - half : 0 : -1]
    np.conjugate(opposite[:, :, :1], out=both[:, :, :1, half:])
    np.conjugate(opposite[:, :, :0:-1], out=both[:, :, 1:, half:])
    for picture, row in np.ndindex(count, cell[0]):
        line = both[picture, row].view(np.float32).reshape(rows, across, 2)
        cv2.dft(line, dst=pictures[picture, :, row], flags=cv2.DFT_INVERSE | cv2.DFT_SCALE)
    return pictures.reshape(count, -1, columns)
