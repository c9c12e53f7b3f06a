"""Demosaicing by linear filters: Malvar, He and Cutler, "High-quality linear interpolation for demosaicing of
Bayer-patterned color images", ICASSP 2004.

The filters are linear on purpose: they keep noise statistics and negative values, and deblurring needs a linear camera.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32

from udccal.cfa import BLUE, GREEN, RED, cfa_named

# Figure 2 of the paper, in eighths: bilinear interpolation, and the other colours' detail that is added to it. The
# picture's own sample is in the middle.
_GREEN_AT_COLOUR = np.array(
    [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]], dtype=np.float32
) / np.float32(8)
_BETWEEN = np.array([[0] * 5, [0] * 5, [0, 4, 0, 4, 0], [0] * 5, [0] * 5], dtype=np.float32) / np.float32(8)
_ALONG_ROW_DETAIL = np.array(
    [[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 0, 5, 0, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]], dtype=np.float32
) / np.float32(8)
_AROUND = np.array([[0] * 5, [0, 2, 0, 2, 0], [0] * 5, [0, 2, 0, 2, 0], [0] * 5], dtype=np.float32) / np.float32(8)
_ACROSS_DETAIL = np.array(
    [[0, 0, -1.5, 0, 0], [0] * 5, [-1.5, 0, 6, 0, -1.5], [0] * 5, [0, 0, -1.5, 0, 0]], dtype=np.float32
) / np.float32(8)


def demosaic(
    mosaic: Float32[np.ndarray, "rows columns"], cfa: str, detail: float = 1.0
) -> Float32[np.ndarray, "rows columns 3"]:
    """Return three colours at every sample. Borders are mirrored, which keeps the pattern.

    Args:
        mosaic: linear samples.
        cfa: name of the colour pattern.
        detail: part of the other colours' detail that red and blue get. The paper's, 1, is closest to a sharp picture;
            it overshoots edges by an eighth of their step, and less detail does so by as much less.
    """
    pattern, part = cfa_named(cfa), np.float32(detail)
    picture = np.empty((*mosaic.shape, 3), dtype=np.float32)
    green = _filtered(mosaic, _GREEN_AT_COLOUR)
    row_kernel = _BETWEEN + part * _ALONG_ROW_DETAIL
    along_row, along_column, across = (
        _filtered(mosaic, kernel)
        for kernel in (row_kernel, np.ascontiguousarray(row_kernel.T), _AROUND + part * _ACROSS_DETAIL)
    )
    for site in pattern.sites:
        at, own = site.samples, site.channel
        picture[(*at, own)] = mosaic[at]
        if own == GREEN:
            picture[(*at, int(pattern.channels[site.row, 1 - site.column]))] = along_row[at]
            picture[(*at, int(pattern.channels[1 - site.row, site.column]))] = along_column[at]
        else:
            picture[(*at, GREEN)] = green[at]
            picture[(*at, RED + BLUE - own)] = across[at]
    return picture


def _filtered(
    mosaic: Float32[np.ndarray, "rows columns"], kernel: Float32[np.ndarray, "k k"]
) -> Float32[np.ndarray, "rows columns"]:
    return cv2.filter2D(mosaic, cv2.CV_32F, kernel, borderType=cv2.BORDER_REFLECT_101)
