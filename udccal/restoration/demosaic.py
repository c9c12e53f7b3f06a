"""Demosaicing by linear filters: Malvar, He and Cutler, "High-quality linear interpolation for demosaicing of
Bayer-patterned color images", ICASSP 2004.

The filters are linear on purpose: they keep noise statistics and negative values, and deblurring needs a linear camera.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32

from udccal.cfa import BLUE, GREEN, RED, cfa_named

# Figure 2 of the paper, in eighths. The picture's own sample is in the middle.
_GREEN_AT_COLOUR = np.array(
    [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]], dtype=np.float32
) / np.float32(8)
_COLOUR_ALONG_ROW = np.array(
    [[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]], dtype=np.float32
) / np.float32(8)
_COLOUR_ALONG_COLUMN = np.ascontiguousarray(_COLOUR_ALONG_ROW.T)
_COLOUR_ACROSS = np.array(
    [[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]],
    dtype=np.float32,
) / np.float32(8)


def demosaic(mosaic: Float32[np.ndarray, "rows columns"], cfa: str) -> Float32[np.ndarray, "rows columns 3"]:
    """Return three colours at every sample. Borders are mirrored, which keeps the pattern."""
    pattern = cfa_named(cfa)
    picture = np.empty((*mosaic.shape, 3), dtype=np.float32)
    green = _filtered(mosaic, _GREEN_AT_COLOUR)
    along_row, along_column, across = (
        _filtered(mosaic, kernel) for kernel in (_COLOUR_ALONG_ROW, _COLOUR_ALONG_COLUMN, _COLOUR_ACROSS)
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
