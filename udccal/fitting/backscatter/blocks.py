"""Compiled functions over any number of positions: in blocks of one size, so that they are compiled once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Array, Shaped

BLOCK = 32


def in_blocks(
    function: Callable[..., tuple[Array, ...]], *columns: Shaped[np.ndarray, "n ..."]
) -> tuple[Shaped[np.ndarray, "n ..."], ...]:
    """``function`` of arrays with one row per position, ``BLOCK`` rows at a time; the last block repeats its last row.

    Args:
        function: takes as many arrays as there are ``columns``, BLOCK rows each; returns arrays of BLOCK rows.
        columns: arrays with the same number of rows, 1 or more.
    """
    count = len(columns[0])
    found = []
    for first in range(0, count, BLOCK):
        rows = np.minimum(np.arange(first, first + BLOCK), count - 1)
        found.append([np.asarray(part) for part in function(*(column[rows] for column in columns))])
    return tuple(np.concatenate(parts)[:count] for parts in zip(*found, strict=True))
