"""Demosaicing and deblurring in one linear filter per tile: the mean of the scene's posterior, given a tile's mosaic.

A mosaic of n sites per cell holds each frequency of a colour n times: as n sites, or as n aliases. Within a tile, with
one kernel per colour and normal distributions, the samples Y at one frequency of the site planes are

    Y = A X + noise,   cov X = s S,   cov noise = 1,   E[X | Y] = s S A^H (s B + 1)^-1 Y,   B = A S A^H,

where X holds the colours at the aliases of this frequency and A the kernels' transfer times each site's phase. S is the
scene's prior spectrum: power |f|^-3 with colours that mostly agree. With B = V^H diag(lambda) V, computed once per
profile, every strength s of the prior costs the same, and the probability of the tile's samples under each s is a sum
over V Y. So each tile chooses its own s, by maximum likelihood (Whittle, 1953). S A^H is a filter from each site plane
to each plane of the picture (polyphase: Vaidyanathan, "Multirate systems and filter banks", 1993), so that transforms
are as small as a site plane.

Samples come in units of their noise. Then one table serves every brightness, exposure and colour of light.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol, TypeAlias, final, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Complex64, Complex128, Float, Float32, Float64, Int
from scipy import fft

from udccal.cfa import Site
from udccal.restoration.kernel_grid import KernelGrid, centred, interpolated_kernels
from udccal.restoration.site_planes import joined_planes, plane_spectra
from udccal.restoration.tiles import TileLayout

# Of the prior, fitted on photographs of two magnifications: the exponent of its power spectrum, the frequency in
# cycles/px below which it is flat, and the variance of a colour's deviation from grey relative to that of the grey.
_EXPONENT, _FLAT_BELOW, COLOURFUL = 3.0, 0.003, 0.2
# The prior's covariance of two colours relative to the variance of grey.
COLOURS = COLOURFUL * np.eye(3) + 1 - COLOURFUL / 3
# Of the variance that colours share, over that of each one's deviation.
COMMON = (1 - COLOURFUL / 3) / COLOURFUL
# Strengths of the prior in units of the noise: RMS difference of neighbours over the sigma of a sample, squared.
STRENGTHS = np.exp2(np.arange(-6.0, 17.0)).astype(np.float32)
# Every n-th frequency along both axes decides the strength.
SPARSE = 3
# Every n-th strength is tried first, then those around the likeliest.
_STRIDE, _HALF_STEPS = 4, (2, 1)
# Every n-th row of cells gives a tile's level.
LEVEL_ROWS = 4

Tiles: TypeAlias = (
    Sequence[Float32[np.ndarray, "*colours rows columns"]] | Float32[np.ndarray, "tiles *colours rows columns"]
)


@runtime_checkable
class Pattern(Protocol):
    """What the filter needs of a colour pattern: a ``Cfa``, or pictures with several colours at one place."""

    @property
    def sites(self) -> tuple[Site, ...]:
        """Samples of a cell."""

    @property
    def rows(self) -> int:
        """Rows of the cell."""

    @property
    def columns(self) -> int:
        """Columns of the cell."""


@runtime_checkable
class Tables(Protocol):
    """What the filter needs of the kernels: of a mosaic, ``FilterTables``; of whole colours, ``ColourTables``."""

    @property
    def matched(self) -> Complex64[np.ndarray, "*tiles places sites site_rows site_half"]:
        """Transfer from each site plane to the picture's plane at each place of the cell."""

    def at(self, tiles: int | Int[np.ndarray, " some"]) -> Tables:
        """Return the tables of one tile, or of several."""

    def along(self, spectra: Complex64[np.ndarray, "sites rows half"]) -> Complex64[np.ndarray, "sites rows half"]:
        """Return the site planes' spectra in the coordinates that the other methods work in."""

    def costs(
        self, along: Complex64[np.ndarray, "sites rows half"], samples: float
    ) -> Callable[[Float32[np.ndarray, " some"]], Float32[np.ndarray, " some"]]:
        """Return the negative log likelihood of a tile's ``samples``, twice and up to a constant, by strength."""

    def solved(
        self, along: Complex64[np.ndarray, "sites rows half"], strength: np.float32
    ) -> Complex64[np.ndarray, "sites rows half"]:
        """Return (B + 1 / s)^-1 Y; ``along`` may be overwritten."""


@final
@dataclass(frozen=True)
class FilterTables:
    """The tables of the kernels of one tile, or of several, of a mosaic.

    Attributes:
        matched: transfer from each site plane of the mosaic to the picture's plane at each place of the cell: prior
            power times the conjugate transfer of the site's colour.
        vectors: V, orthonormal, by eigenvalue and site, at the site planes' frequencies.
        values: lambda, in units of the noise.
    """

    matched: Complex64[np.ndarray, "*tiles places sites site_rows site_half"]
    vectors: Complex64[np.ndarray, "*tiles sites sites site_rows site_half"]
    values: Float32[np.ndarray, "*tiles sites site_rows site_half"]

    def at(self, tiles: int | Int[np.ndarray, " some"]) -> FilterTables:
        """Return the tables of one tile, or of several."""
        return FilterTables(self.matched[tiles], self.vectors[tiles], self.values[tiles])

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
    """Compute the tables of every tile of a mosaic.

    Args:
        grid: kernels over the sensor.
        layout: the tiles.
        pattern: the colour pattern, whose cell divides the tiles.
        workers: threads.
    """
    kernels = interpolated_kernels(grid, layout.centres_px)
    density = prior_density(layout.rows, layout.columns)
    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(lambda kernel: _tables_of(kernel, density, pattern), kernels))
    return FilterTables(*(np.stack(column) for column in zip(*parts, strict=True)))


def prior_density(rows: int, columns: int) -> Float64[np.ndarray, "rows columns"]:
    """Return the prior's power spectrum at strength 1: its mean square difference of neighbours is 1."""
    y, x = np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(columns)
    power = (y**2 + x**2 + _FLAT_BELOW**2) ** (-_EXPONENT / 2)
    differences = 2 * (np.sin(np.pi * y) ** 2 + np.sin(np.pi * x) ** 2)
    return power / np.mean(power * differences)


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


def filtered(
    tiles: Float32[np.ndarray, "tiles *colours rows columns"],
    noise_e: Float32[np.ndarray, "tiles 3"],
    tables: Tables,
    layout: TileLayout,
    pattern: Pattern,
    workers: int,
    strengths: Float32[np.ndarray, "tiles"] | None = None,
) -> tuple[Float32[np.ndarray, "tiles rows columns 3"], Float32[np.ndarray, " tiles"]]:
    """Demosaic and deblur tiles.

    Args:
        tiles: signal in e-, backscatter subtracted; with an axis of colours where the pattern's sites share a place.
        noise_e: sigma of a sample of each colour in e-.
        tables: of the same tiles.
        layout: of the same tiles.
        pattern: the colour pattern.
        workers: threads.
        strengths: of each tile's prior; None to choose the likeliest.

    Returns:
        pictures in e-, and the strength of the prior that each tile chose, in units of its noise.
    """
    pictures = np.empty((len(tiles), layout.rows, layout.columns, 3), dtype=np.float32)
    given = tiles, noise_e, tables, layout, pattern, workers, strengths
    return pictures, _filter_each(*given, [range(len(tiles))], pictures.__setitem__)


def filtered_and_joined(
    tiles: Tiles,
    noise_e: Float32[np.ndarray, "tiles 3"],
    tables: Tables,
    layout: TileLayout,
    pattern: Pattern,
    workers: int,
    strengths: Float32[np.ndarray, "tiles"] | None = None,
) -> tuple[Float32[np.ndarray, "covered_rows frame_columns 3"], Float32[np.ndarray, " tiles"]]:
    """Demosaic and deblur all tiles of a layout, and blend their pictures into one.

    Every picture is blended while a core's cache has it. Arguments and strengths are those of ``filtered``.
    """
    joined = np.zeros((*layout.covered, 3), dtype=np.float32)
    given = tiles, noise_e, tables, layout, pattern, workers, strengths
    return joined, _filter_each(*given, layout.apart, lambda index, picture: layout.blend(picture, index, joined))


def _filter_each(
    tiles: Tiles,
    noise_e: Float32[np.ndarray, "tiles 3"],
    tables: Tables,
    layout: TileLayout,
    pattern: Pattern,
    workers: int,
    strengths: Float32[np.ndarray, "tiles"] | None,
    groups: Iterable[Sequence[int]],
    take: Callable[[int, Float32[np.ndarray, "rows columns 3"]], None],
) -> Float32[np.ndarray, " tiles"]:
    """Filter one group of tiles after the other, hand over every picture, and return the strengths."""
    chosen = np.empty(len(tiles), dtype=np.float32)

    def one(index: int) -> None:
        own = noise_e[index], tables.at(index), layout, pattern, None if strengths is None else strengths[index]
        picture, chosen[index] = _filtered_tile(tiles[index], *own)
        take(index, picture)

    with ThreadPoolExecutor(workers) as pool:
        for group in groups:
            list(pool.map(one, group))
    return chosen


def _filtered_tile(
    tile: Float32[np.ndarray, "*colours rows columns"],
    noise_e: Float32[np.ndarray, "3"],
    tables: Tables,
    layout: TileLayout,
    pattern: Pattern,
    strength: np.float32 | None,
) -> tuple[Float32[np.ndarray, "rows columns 3"], np.float32]:
    levels = _levels(tile, pattern)
    spectrum = _whitened(tile, levels, noise_e, tables, layout, pattern)
    if strength is None:
        samples = layout.power / (pattern.rows * pattern.columns)
        strength = _likeliest(tables.costs(spectrum, samples))
    return _picture(spectrum, strength, levels, noise_e, tables, layout, pattern), strength


def _levels(tile: Float32[np.ndarray, "*colours rows columns"], pattern: Pattern) -> Float32[np.ndarray, "3"]:
    """Return about the mean of each colour; a colour without sites is as bright as the mean of all.

    The prior's power at the lowest frequency is so high that the samples have the last word.
    """
    step = LEVEL_ROWS * pattern.rows
    lines = [layer[row::step] for layer in _layers(tile) for row in range(pattern.rows)]
    by_line = [cv2.mean(line.reshape(len(line), -1, pattern.columns))[: pattern.columns] for line in lines]
    of_site, channels = np.array(by_line, dtype=np.float32).ravel(), channels_of(pattern)
    own = [channels == colour for colour in range(len(COLOURS))]
    return np.array([of_site[mine].mean() if mine.any() else of_site.mean() for mine in own], dtype=np.float32)


def channels_of(pattern: Pattern) -> Int[np.ndarray, " sites"]:
    """Return the colour of each site."""
    return np.array([site.channel for site in pattern.sites])


def _layers(tile: Float32[np.ndarray, "*colours rows columns"]) -> Float32[np.ndarray, "layers rows columns"]:
    return tile[None] if tile.ndim == 2 else tile


def _whitened(
    tile: Float32[np.ndarray, "*colours rows columns"],
    levels: Float32[np.ndarray, "3"],
    noise_e: Float32[np.ndarray, "3"],
    tables: Tables,
    layout: TileLayout,
    pattern: Pattern,
) -> Complex64[np.ndarray, "sites site_rows site_half"]:
    """Return the tile's samples in units of their noise, less their colours' levels, in the tables' coordinates."""
    cell = pattern.rows, pattern.columns
    parts = []
    cells = (each[channels_of(pattern)].reshape(-1, *cell) for each in (levels, 1 / noise_e))
    for layer, *of_cell in zip(_layers(tile), *cells, strict=True):
        flat = np.empty_like(layer)
        for row, (level, scale) in enumerate(zip(*of_cell, strict=True)):
            line = flat[row :: cell[0]]
            np.subtract(layer[row :: cell[0]], np.tile(level, layer.shape[1] // cell[1]), out=line)
            line *= np.tile(scale, layer.shape[1] // cell[1])
        flat *= layout.taper
        parts.append(plane_spectra(flat, cell))
    spectrum = parts[0] if len(parts) == 1 else np.concatenate(parts)
    return tables.along(spectrum)


def _picture(
    whitened: Complex64[np.ndarray, "sites site_rows site_half"],
    strength: np.float32,
    levels: Float32[np.ndarray, "3"],
    noise_e: Float32[np.ndarray, "3"],
    tables: Tables,
    layout: TileLayout,
    pattern: Pattern,
) -> Float32[np.ndarray, "rows columns 3"]:
    """Return the posterior's mean in e-."""
    by_site = tables.solved(whitened, strength)
    cell, channels = (pattern.rows, pattern.columns), channels_of(pattern)
    matched = tables.matched
    mixed = np.zeros((len(COLOURS), len(matched), *by_site.shape[1:]), dtype=np.complex64)
    for colour, spectrum in enumerate(mixed):
        own = _evenly(np.flatnonzero(channels == colour))
        np.sum(matched[:, own] * by_site[own], axis=1, out=spectrum)
    # Colours have much that cancels in their sum. In single precision, they are mixed before they become pictures.
    common = mixed.sum(axis=0)
    common *= np.float32(COMMON)
    mixed += common
    planes = joined_planes(mixed, cell, layout.columns)
    return cv2.transform(cv2.merge(list(planes)), np.column_stack([np.diag(COLOURFUL * noise_e), levels]))


def _evenly(sites: Int[np.ndarray, " some"]) -> slice | Int[np.ndarray, " some"]:
    """Return indices as a slice, which needs no copy, where they are two at most."""
    if not 1 <= len(sites) <= 2:
        return sites
    first, last = int(sites[0]), int(sites[-1])
    return slice(first, last + 1, max(last - first, 1))


def _products(
    matrices: Complex64[np.ndarray, "to sites site_rows site_half"],
    spectra: Complex64[np.ndarray, "sites site_rows site_half"],
) -> Complex64[np.ndarray, "to site_rows site_half"]:
    """Return the product of a matrix and a vector at each frequency. Few calls: threads wait for each other at each."""
    found: Complex64[np.ndarray, "to site_rows site_half"] = (matrices * spectra).sum(axis=1)
    return found


def _likeliest(costs: Callable[[Float32[np.ndarray, " some"]], Float32[np.ndarray, " some"]]) -> np.float32:
    """Return the prior's strength under which a tile's samples are most probable."""

    def cheapest(indices: Iterable[int]) -> int:
        """Return the likeliest of some strengths, all of which are tried at once: threads wait for every call."""
        some = [index for index in indices if 0 <= index < len(STRENGTHS)]
        return some[int(costs(STRENGTHS[some]).argmin())]

    # The cost has one valley: first where it is, then by half steps where it is lowest.
    best = cheapest(range(0, len(STRENGTHS), _STRIDE))
    for step in _HALF_STEPS:
        best = cheapest((best - step, best, best + step))
    return STRENGTHS[best]
