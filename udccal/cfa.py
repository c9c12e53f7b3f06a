"""Colour filter arrays: which colour, and which site of the repeating cell, each sample of a mosaic belongs to.

A pattern that a new camera needs is one more entry of ``PATTERNS``.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from jaxtyping import Float, Int, Real

RED, GREEN, BLUE = 0, 1, 2
# A sensor without colours counts as green, where its sensitivity is highest.
_CHANNELS: Final = {"R": RED, "G": GREEN, "B": BLUE, "M": GREEN}


@final
@dataclass(frozen=True)
class Site:
    """One place of the cell.

    Attributes:
        row, column: from the cell's top left.
        channel: 0 = R, 1 = G, 2 = B.
        samples: slices of a mosaic that take this site's samples.
    """

    row: int
    column: int
    channel: int
    samples: tuple[slice, slice]


@final
@dataclass(frozen=True)
class Cfa:
    """One pattern.

    Attributes:
        name: as rigs, sessions and profiles say it.
        cell: letters R, G, B (M without colours) of the top-left cell, a word per row.
        family: beginning of the names of its formats in the GenICam Pixel Format Naming Convention.
    """

    name: str
    cell: tuple[str, ...]
    family: str

    @property
    def rows(self) -> int:
        """Rows of the cell."""
        return len(self.cell)

    @property
    def columns(self) -> int:
        """Columns of the cell."""
        return len(self.cell[0])

    @functools.cached_property
    def sites(self) -> tuple[Site, ...]:
        """The cell's places, row by row."""
        return tuple(
            Site(j, i, _CHANNELS[letter], (slice(j, None, self.rows), slice(i, None, self.columns)))
            for j, word in enumerate(self.cell)
            for i, letter in enumerate(word)
        )

    @property
    def channels(self) -> Int[np.ndarray, "cell_rows cell_columns"]:
        """Channel of each site."""
        return np.array([site.channel for site in self.sites]).reshape(self.rows, self.columns)

    @property
    def colours(self) -> tuple[int, ...]:
        """Channels that the pattern has: one of a sensor without colours."""
        return tuple(sorted({site.channel for site in self.sites}))

    def channel_map(self, rows: int, columns: int) -> Int[np.ndarray, "rows columns"]:
        """Channel of every sample of a mosaic of that size."""
        return self._repeated(self.channels, rows, columns)

    def site_map(self, rows: int, columns: int) -> Int[np.ndarray, "rows columns"]:
        """Index into ``sites`` of every sample of a mosaic of that size."""
        return self._repeated(np.arange(len(self.sites)).reshape(self.rows, self.columns), rows, columns)

    def cell_means(self, mosaic: Real[np.ndarray, "rows columns"]) -> Float[np.ndarray, "cells_down cells_across 3"]:
        """Each colour's mean in every whole cell; a colour that the cell lacks has the mean of all its samples."""
        down, across = mosaic.shape[0] // self.rows, mosaic.shape[1] // self.columns
        cells = mosaic[: down * self.rows, : across * self.columns].reshape(down, self.rows, across, self.columns)
        own = [self.channels == channel for channel in (RED, GREEN, BLUE)]
        by_cell = cells.transpose(0, 2, 1, 3)
        return np.stack([by_cell[..., o if o.any() else ~o].mean(axis=-1) for o in own], axis=-1)

    def _repeated(
        self, cell: Int[np.ndarray, "cell_rows cell_columns"], rows: int, columns: int
    ) -> Int[np.ndarray, "rows columns"]:
        return np.tile(cell, (-(-rows // self.rows), -(-columns // self.columns)))[:rows, :columns]


_BAYER: Final = {"RGGB": "BayerRG", "GRBG": "BayerGR", "GBRG": "BayerGB", "BGGR": "BayerBG"}
PATTERNS: Final[dict[str, Cfa]] = {
    "mono": Cfa("mono", ("M",), "Mono"),
    **{name: Cfa(name, (name[:2], name[2:]), family) for name, family in _BAYER.items()},
}


def cfa_named(name: str) -> Cfa:
    """The pattern of that name; ``RGGB`` (the top-left 2 x 2, row by row) is GenICam's BayerRG.

    Raises:
        ValueError: when there is none.
    """
    if name not in PATTERNS:
        raise ValueError(f"expected one of the CFA patterns {', '.join(PATTERNS)}, found '{name[:20]}'")
    return PATTERNS[name]
