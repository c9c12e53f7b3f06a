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
    lines = [mosaic[row :: cell[0]] for row in range(cell[0])]
    if cell[1] != 2:
        return fft.rfft2(np.stack([line[:, column :: cell[1]] for line in lines for column in range(cell[1])]))
    rows, columns = mosaic.shape[0] // cell[0], mosaic.shape[1] // 2
    half = columns // 2 + 1
    spectra = np.empty((len(lines), 2, rows, half), dtype=np.complex64)
    for (even, odd), line in zip(spectra, lines, strict=True):
        both = cv2.dft(line.reshape(rows, columns, 2)).view(np.complex64)[..., 0]
        mirrored = _conjugate_at_opposite(both, half)
        np.add(both[:, :half], mirrored, out=even)
        np.subtract(both[:, :half], mirrored, out=odd)
        even *= np.float32(0.5)
        odd *= np.complex64(-0.5j)
    return spectra.reshape(-1, rows, half)


def _conjugate_at_opposite(
    spectrum: Complex64[np.ndarray, "rows columns"], half: int
) -> Complex64[np.ndarray, "rows half"]:
    """Return conj(spectrum) at -f for the frequencies f of a half spectrum."""
    opposite = np.empty((len(spectrum), half), dtype=np.complex64)
    for to, of in ((slice(1), slice(1)), (slice(1, None), slice(None, 0, -1))):
        np.conjugate(spectrum[of, :1], out=opposite[to, :1])
        np.conjugate(spectrum[of, :-half:-1], out=opposite[to, 1:])
    return opposite


def joined_planes(
    spectra: Complex64[np.ndarray, "places site_rows site_half"], cell: tuple[int, int], columns: int
) -> Float32[np.ndarray, "rows columns"]:
    """Return the picture whose planes have these transforms.

    Args:
        spectra: as ``plane_spectra`` returns them.
        cell: (rows, columns) of the colour pattern.
        columns: of the picture.
    """
    rows, across, half = spectra.shape[1], columns // cell[1], spectra.shape[2]
    picture = np.empty((rows * cell[0], columns), dtype=np.float32)
    by_line = spectra.reshape(*cell, rows, half)
    if cell[1] != 2:
        for row, column in np.ndindex(*cell):
            picture[row :: cell[0], column :: cell[1]] = fft.irfft2(by_line[row, column], s=(rows, across))
        return picture
    both = np.empty((rows, across), dtype=np.complex64)
    for row, (even, odd) in enumerate(by_line):
        turned = odd * np.complex64(1j)
        np.add(even, turned, out=both[:, :half])
        # What a whole spectrum has on its other half.
        opposite = np.subtract(even, turned, out=turned)[:, across - half : 0 : -1]
        np.conjugate(opposite[:1], out=both[:1, half:])
        np.conjugate(opposite[:0:-1], out=both[1:, half:])
        line = picture[row :: cell[0]].reshape(rows, across, 2)
        cv2.dft(both.view(np.float32).reshape(rows, across, 2), dst=line, flags=cv2.DFT_INVERSE | cv2.DFT_SCALE)
    return picture
