"""Tables of the filter for mosaics: an eigenvalue decomposition at every frequency of a tile's site planes.

The words are those of ``mosaic_filter``. A mosaic of n sites per cell holds each frequency of a colour n times, as
aliases, so that B is a matrix of n x n without a closed inverse.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Complex64, Complex128, Float, Float32, Float64, Int
from scipy import fft

from udccal.restoration.kernel_grid import KernelGrid, centred, interpolated_kernels
from udccal.restoration.mosaic_filter import Pattern
from udccal.restoration.scene_prior import COLOURS, prior_density
from udccal.restoration.tiles import TileLayout

# Every n-th frequency along both axes decides the strength.
SPARSE = 3


@final
@dataclass(frozen=True)
class FilterTables:
    """The tables of one kernel, or of several.

    Attributes:
        matched: transfer from each site plane of the mosaic to the picture's plane at each place of the cell: prior
            power times the conjugate transfer of the site's colour.
        vectors: V, orthonormal, by eigenvalue and site, at the site planes' frequencies.
        values: lambda, in units of the noise.
    """

    matched: Complex64[np.ndarray, "*kernels places sites site_rows site_half"]
    vectors: Complex64[np.ndarray, "*kernels sites sites site_rows site_half"]
    values: Float32[np.ndarray, "*kernels sites site_rows site_half"]

    def at(self, kernels: int | Int[np.ndarray, " some"]) -> FilterTables:
        """Return the tables of one kernel, or of several."""
        return FilterTables(self.matched[kernels], self.vectors[kernels], self.values[kernels])

    def along(self, spectra: Complex64[np.ndarray, "sites rows half"]) -> Complex64[np.ndarray, "sites rows half"]:
        """Return V Y: along the eigenvectors."""
        return _products(self.vectors, spectra)

    def costs(
        self, along: Complex64[np.ndarray, "sites rows half"], samples: float
    ) -> Callable[[Float32[np.ndarray, " some"]], Float32[np.ndarray, " some"]]:
        """Return the likelihood of every n-th frequency, ready for any strengths; see ``Tables``."""
        some = along[:, ::SPARSE, ::SPARSE]
        power = (power_of(some) / np.float32(samples)).ravel()
        value = self.values[:, ::SPARSE, ::SPARSE].ravel()

        def costs(strengths: Float32[np.ndarray, " some"]) -> Float32[np.ndarray, " some"]:
            variance = strengths[:, None] * value
            variance += 1
            found: Float32[np.ndarray, " some"] = np.log(variance).sum(axis=1)
            return found + np.divide(power, variance, out=variance).sum(axis=1)

        return costs

    def solved(
        self, along: Complex64[np.ndarray, "sites rows half"], strength: np.float32
    ) -> Complex64[np.ndarray, "sites rows half"]:
        """Return (B + 1 / s)^-1 Y."""
        weighted = np.conjugate(along)
        weighted *= 1 / (self.values + 1 / strength)
        return np.conjugate(_products(self.vectors.swapaxes(0, 1), weighted), out=weighted)


def power_of(values: Complex64[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Return the square of each number's size."""
    return values.real**2 + values.imag**2


def filter_tables(grid: KernelGrid, layout: TileLayout, pattern: Pattern, workers: int) -> FilterTables:
    """Compute the tables of every kernel of a layout.

    Args:
        grid: kernels over the sensor.
        layout: the tiles.
        pattern: the colour pattern, whose cell divides the tiles.
        workers: threads.
    """
    kernels = interpolated_kernels(grid, layout.kernel_px)
    density = prior_density(layout.rows, layout.columns)
    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(lambda kernel: _tables_of(kernel, density, pattern), kernels))
    return FilterTables(*(np.stack(column) for column in zip(*parts, strict=True)))


def _tables_of(
    kernels: Float[np.ndarray, "3 ky kx"], density: Float64[np.ndarray, "rows columns"], pattern: Pattern
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, columns = density.shape
    transfer = fft.fft2(np.stack([centred(kernel, rows, columns) for kernel in kernels]))
    half, count, aliases = columns // pattern.columns // 2 + 1, len(pattern.sites), pattern.rows * pattern.columns
    seen = [
        phase * transfer[site.channel]
        for site, phase in zip(pattern.sites, _phases(rows, columns, pattern), strict=True)
    ]
    matrix = np.empty((rows // pattern.rows, half, count, count), dtype=np.complex128)
    for i, own in enumerate(pattern.sites):
        for j, other in enumerate(pattern.sites[: i + 1]):
            product = density * seen[i] * np.conj(seen[j])
            folded = product.reshape(pattern.rows, rows // pattern.rows, pattern.columns, -1).sum(axis=(0, 2))[:, :half]
            matrix[..., i, j] = folded * (COLOURS[own.channel, other.channel] / aliases)
            matrix[..., j, i] = np.conj(matrix[..., i, j])
    values, vectors = np.linalg.eigh(matrix)
    # In the order in which they are read: a filter takes half as long again where frequencies do not lie side by side.
    return (
        _polyphase(fft.ifft2(density * np.conj(transfer)).real, pattern).astype(np.complex64),
        np.conj(np.moveaxis(vectors, (3, 2), (0, 1))).astype(np.complex64, order="C"),
        np.moveaxis(np.maximum(values, 0.0), 2, 0).astype(np.float32, order="C"),
    )


def _phases(rows: int, columns: int, pattern: Pattern) -> list[Complex128[np.ndarray, "rows columns"]]:
    """Return exp(2 pi i f.p) for the place p of every site."""
    y, x = np.arange(rows)[:, None] / rows, np.arange(columns) / columns
    return [np.exp(2j * np.pi * (y * site.row + x * site.column)) for site in pattern.sites]


def _polyphase(
    filters: Float64[np.ndarray, "3 rows columns"], pattern: Pattern
) -> Complex128[np.ndarray, "places sites site_rows site_half"]:
    """Return the transfer from each site plane to each plane of a picture, for one periodic filter per colour."""
    moved = [np.roll(filters[site.channel], (site.row, site.column), axis=(0, 1)) for site in pattern.sites]
    places = itertools.product(range(pattern.rows), range(pattern.columns))
    return fft.rfft2(np.array([[each[y :: pattern.rows, x :: pattern.columns] for each in moved] for y, x in places]))


def _products(
    matrices: Complex64[np.ndarray, "to sites site_rows site_half"],
    spectra: Complex64[np.ndarray, "sites site_rows site_half"],
) -> Complex64[np.ndarray, "to site_rows site_half"]:
    """Return the product of a matrix and a vector at each frequency. Few calls: threads wait for each other at each."""
    found: Complex64[np.ndarray, "to site_rows site_half"] = (matrices * spectra).sum(axis=1)
    return found
