"""Colour filter arrays: which colour and which site of the 2 x 2 cell each sample of a mosaic belongs to."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

RED, GREEN, BLUE = 0, 1, 2
# Of the 2 x 2 cell.
SITES = 4
_CHANNELS = {"R": RED, "G": GREEN, "B": BLUE}


def cell_channels(cfa: str) -> Int[np.ndarray, "2 2"]:
    """Channel (0 = R, 1 = G, 2 = B) of each site of the top-left 2 x 2 cell; ``RGGB`` is GenICam's BayerRG.

    Raises:
        ValueError: when ``cfa`` is not four letters of R, G, B.
    """
    if len(cfa) != 4 or any(letter not in _CHANNELS for letter in cfa):
        raise ValueError(f"expected a CFA pattern of four letters R, G, B such as 'RGGB', found '{cfa}'")
    return np.array([_CHANNELS[letter] for letter in cfa]).reshape(2, 2)


def channel_map(cfa: str, rows: int, columns: int) -> Int[np.ndarray, "rows columns"]:
    """Channel (0 = R, 1 = G, 2 = B) of every sample of a mosaic whose top-left 2 x 2 is ``cfa``."""
    tiles = (-(-rows // 2), -(-columns // 2))
    return np.tile(cell_channels(cfa), tiles)[:rows, :columns]


def site_map(rows: int, columns: int) -> Int[np.ndarray, "rows columns"]:
    """Site 0..3 in the 2 x 2 cell (row-major from the top left) of every sample of a mosaic."""
    return np.tile(np.arange(SITES).reshape(2, 2), (-(-rows // 2), -(-columns // 2)))[:rows, :columns]


def offset_pattern(cfa: str, x: int, y: int) -> str:
    """Pattern of the 2 x 2 cell whose first sample is the sensor's (``x``, ``y``)."""
    return "".join(cfa[2 * ((y + j) % 2) + (x + i) % 2] for j in (0, 1) for i in (0, 1))
