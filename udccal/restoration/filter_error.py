"""What the filter of each tile is expected to leave wrong: noise that it passes, and detail that it takes for noise.

With the words of ``mosaic_filter`` and W = s S A^H (s B + 1)^-1: where cov X = s S, the filter's error has the
covariance s S - W A s S. Part of it is noise that passed, W W^H; the rest is lost detail. Both are variances of a
colour's samples in units of its noise. ``blur`` is the variance of what the panel's kernel alone changes, per unit of
the prior's strength.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from jaxtyping import Float32, Float64
from scipy import fft

from udccal.cfa import Cfa
from udccal.restoration.kernel_grid import KernelGrid, centred, interpolated_kernels
from udccal.restoration.mosaic_filter import COLOURS, STRENGTHS, FilterTables, prior_density
from udccal.restoration.tiles import TileLayout

# Every n-th frequency along both axes is looked at.
_SPARSE: Final = 3


@final
@dataclass(frozen=True)
class FilterError:
    """Expected variances of each tile's error, by strength of the prior and colour.

    Attributes:
        noise: what the filter passes of unit noise.
        lost: detail that it loses under the prior.
        blur: what the kernel changes of a scene with the prior at strength 1.
    """

    noise: Float32[np.ndarray, "tiles strengths 3"]
    lost: Float32[np.ndarray, "tiles strengths 3"]
    blur: Float32[np.ndarray, "tiles 3"]


def filter_error(grid: KernelGrid, tables: FilterTables, layout: TileLayout, cfa: Cfa) -> FilterError:
    """Evaluate the expected errors of every tile.

    Args:
        grid: kernels over the sensor.
        tables: of the tiles' filters.
        layout: the tiles.
        cfa: the colour pattern.
    """
    density = prior_density(layout.rows, layout.columns)
    parts = [
        _passed_and_lost(np.asarray(matched), np.asarray(vectors), np.asarray(values), density, cfa)
        for matched, vectors, values in zip(tables.matched, tables.vectors, tables.values, strict=True)
    ]
    changed = [
        [
            np.mean(density * np.abs(1 - fft.fft2(centred(kernel, layout.rows, layout.columns))) ** 2) * COLOURS[c, c]
            for c, kernel in enumerate(kernels)
        ]
        for kernels in interpolated_kernels(grid, layout.centres_px)
    ]
    noise, lost = (np.array(column, dtype=np.float32) for column in zip(*parts, strict=True))
    return FilterError(noise, lost, np.array(changed, dtype=np.float32))


def _passed_and_lost(
    matched: np.ndarray, vectors: np.ndarray, values: np.ndarray, density: Float64[np.ndarray, "rows columns"], cfa: Cfa
) -> tuple[Float64[np.ndarray, "strengths 3"], Float64[np.ndarray, "strengths 3"]]:
    """Return the noise that one tile's filter passes, and the detail that it loses."""
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
    noise, lost = np.empty((len(STRENGTHS), 3)), np.empty((len(STRENGTHS), 3))
    for colour in range(3):
        mixed = by_site * COLOURS[colour, channels][:, None]
        gain = np.abs(np.einsum("jf,ijf->if", mixed, np.conj(vector))) ** 2 / (cfa.rows * cfa.columns)
        prior = density[down, across] * COLOURS[colour, colour]
        for index, s in enumerate(STRENGTHS.astype(float)):
            solved = s * value + 1
            passed = (gain * (s / solved) ** 2).sum(axis=0)
            found = (gain * s**2 / solved).sum(axis=0)
            noise[index, colour] = weights @ passed
            lost[index, colour] = weights @ np.maximum(s * prior - found - passed, 0.0)
    return noise, lost


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
