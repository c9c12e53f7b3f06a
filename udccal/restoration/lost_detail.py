"""The detail that a tile's filter is expected to lose: what it takes for noise.

With the words of ``mosaic_filter`` and W = s S A^H (s B + 1)^-1: where cov X = s S, the filter's error has the
covariance s S - W A s S. Part of it is noise that passed, W W^H; the rest is lost detail. It is a variance of a
colour's samples in units of its noise.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from jaxtyping import Float32, Float64

from udccal.cfa import Cfa
from udccal.restoration.filter_tables import FilterTables
from udccal.restoration.scene_prior import COLOURS, STRENGTHS, prior_density
from udccal.restoration.tiles import TileLayout

# Every n-th frequency along both axes is looked at.
_SPARSE: Final = 3


@final
@dataclass(frozen=True)
class LostDetail:
    """What the filter of each kernel loses.

    Attributes:
        variance: of detail under the prior, by strength of the prior and colour.
    """

    variance: Float32[np.ndarray, "kernels strengths 3"]


def lost_detail(tables: FilterTables, layout: TileLayout, cfa: Cfa) -> LostDetail:
    """Evaluate the detail that is lost with every kernel.

    Args:
        tables: of the filters.
        layout: the tiles.
        cfa: the colour pattern.
    """
    density = prior_density(layout.rows, layout.columns)
    parts = [
        _lost(np.asarray(matched), np.asarray(vectors), np.asarray(values), density, cfa)
        for matched, vectors, values in zip(tables.matched, tables.vectors, tables.values, strict=True)
    ]
    return LostDetail(np.array(parts, dtype=np.float32))


def _lost(
    matched: np.ndarray, vectors: np.ndarray, values: np.ndarray, density: Float64[np.ndarray, "rows columns"], cfa: Cfa
) -> Float64[np.ndarray, "strengths 3"]:
    """Return the detail that one kernel's filter loses."""
    rows, columns = density.shape
    down, across = (
        axis.ravel()
        for axis in np.meshgrid(np.arange(0, rows, _SPARSE), np.arange(0, columns // 2 + 1, _SPARSE), indexing="ij")
    )
    # Other frequencies of a row are conjugates of these.
    weights = np.where((across == 0) | (2 * across == columns), 1.0, 2.0)
    weights /= weights.sum()
    folded = _Folded.of(down, across, rows // cfa.rows, columns // cfa.columns)
    of_place = folded.pick(matched)
    places = itertools.product(range(cfa.rows), range(cfa.columns))
    phases = [np.exp(-2j * np.pi * (down * y / rows + across * x / columns)) for y, x in places]
    by_site = sum(phase * place for phase, place in zip(phases, of_place, strict=True))
    vector, value = folded.pick(vectors), folded.pick(values).real
    channels = [site.channel for site in cfa.sites]
    lost = np.empty((len(STRENGTHS), 3))
    for colour in range(3):
        mixed = by_site * COLOURS[colour, channels][:, None]
        gain = np.abs(np.einsum("jf,ijf->if", mixed, np.conj(vector))) ** 2 / (cfa.rows * cfa.columns)
        prior = density[down, across] * COLOURS[colour, colour]
        for index, s in enumerate(STRENGTHS.astype(float)):
            solved = s * value + 1
            passed = (gain * (s / solved) ** 2).sum(axis=0)
            found = (gain * s**2 / solved).sum(axis=0)
            lost[index, colour] = weights @ np.maximum(s * prior - found - passed, 0.0)
    return lost


@final
@dataclass(frozen=True)
class _Folded:
    """Frequencies of the picture, at those of the site planes' half spectrum, of which others are conjugates."""

    row: np.ndarray
    column: np.ndarray
    conjugate: np.ndarray

    @classmethod
    def of(cls, down: np.ndarray, across: np.ndarray, rows: int, columns: int) -> _Folded:
        row, column = down % rows, across % columns
        conjugate = column > columns // 2
        return cls(np.where(conjugate, -row % rows, row), np.where(conjugate, columns - column, column), conjugate)

    def pick(self, spectra: np.ndarray) -> np.ndarray:
        """Return the spectra, whose last axes are a half spectrum, at these frequencies."""
        found = spectra[..., self.row, self.column]
        return np.where(self.conjugate, np.conj(found), found)
