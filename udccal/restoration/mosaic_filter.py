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

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Protocol, TypeAlias, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Complex64, Float32, Int

from udccal.cfa import Site
from udccal.restoration.scene_prior import COLOURFUL, COLOURS, COMMON, STRENGTHS
from udccal.restoration.site_planes import joined_planes, plane_spectra
from udccal.restoration.tiles import TileLayout

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
    def matched(self) -> Complex64[np.ndarray, "*kernels places sites site_rows site_half"]:
        """Transfer from each site plane to the picture's plane at each place of the cell."""

    def at(self, kernels: int | Int[np.ndarray, " some"]) -> Tables:
        """Return the tables of one kernel, or of several."""

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


def filtered(
    tiles: Float32[np.ndarray, "tiles *colours rows columns"],
    noise_e: Float32[np.ndarray, "tiles 3"],
    tables: Tables,
    layout: TileLayout,
    pattern: Pattern,
    strengths: Float32[np.ndarray, "tiles"] | None = None,
) -> tuple[Float32[np.ndarray, "tiles rows columns 3"], Float32[np.ndarray, " tiles"]]:
    """Demosaic and deblur tiles.

    They follow each other on one core: two threads would wait for the interpreter so often that they take as long.

    Args:
        tiles: signal in e-, backscatter subtracted; with an axis of colours where the pattern's sites share a place.
        noise_e: sigma of a sample of each colour in e-.
        tables: of each tile's kernel.
        layout: of the tiles.
        pattern: the colour pattern.
        strengths: of each tile's prior; None to choose the likeliest.

    Returns:
        pictures in e-, and the strength of the prior that each tile chose, in units of its noise.
    """
    pictures = np.empty((len(tiles), layout.rows, layout.columns, 3), dtype=np.float32)
    chosen = np.empty(len(tiles), dtype=np.float32)
    for index, made in enumerate(_filter_each(tiles, noise_e, tables.at, layout, pattern, strengths)):
        pictures[index], chosen[index] = made
    return pictures, chosen


def filtered_and_joined(
    tiles: Tiles,
    noise_e: Float32[np.ndarray, "tiles 3"],
    tables: Tables,
    layout: TileLayout,
    pattern: Pattern,
    strengths: Float32[np.ndarray, "tiles"] | None = None,
) -> tuple[Float32[np.ndarray, "covered_rows frame_columns 3"], Float32[np.ndarray, " tiles"]]:
    """Demosaic and deblur all tiles of a layout, and blend their pictures into one.

    Every picture is blended while the core's cache has it. Arguments and strengths are those of ``filtered``, but that
    ``tables`` are those of the layout's kernels.
    """
    joined, chosen = np.zeros((*layout.covered, 3), dtype=np.float32), np.empty(len(tiles), dtype=np.float32)
    given = tiles, noise_e, lambda index: tables.at(int(layout.kernel[index])), layout, pattern, strengths
    for index, (picture, strength) in enumerate(_filter_each(*given)):
        layout.blend(picture, index, joined)
        chosen[index] = strength
    return joined, chosen


def likeliest_strength(
    tile: Float32[np.ndarray, "*colours rows columns"],
    noise_e: Float32[np.ndarray, "3"],
    tables: Tables,
    layout: TileLayout,
    pattern: Pattern,
) -> np.float32:
    """Return the strength of the prior that a tile chooses. Arguments are those of ``filtered``, of one tile."""
    spectrum = _whitened(tile, _levels(tile, pattern), noise_e, tables, layout, pattern)
    return _chosen(spectrum, tables, layout, pattern)


def _filter_each(
    tiles: Tiles,
    noise_e: Float32[np.ndarray, "tiles 3"],
    tables_of: Callable[[int], Tables],
    layout: TileLayout,
    pattern: Pattern,
    strengths: Float32[np.ndarray, " tiles"] | None,
) -> Iterator[tuple[Float32[np.ndarray, "rows columns 3"], np.float32]]:
    """Filter one tile after the other: their pictures and strengths."""
    for index, tile in enumerate(tiles):
        given = None if strengths is None else strengths[index]
        yield _filtered_tile(tile, noise_e[index], tables_of(index), layout, pattern, given)


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
        strength = _chosen(spectrum, tables, layout, pattern)
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
    # By place of the cell, of each layer; the samples of a cell's row lie side by side.
    level, scale = (
        np.tile(each[channels_of(pattern)].reshape(-1, *cell), tile.shape[-1] // cell[1])
        for each in (levels, 1 / noise_e)
    )
    parts = []
    for layer, own_level, own_scale in zip(_layers(tile), level, scale, strict=True):
        rows = layer.reshape(-1, cell[0], layer.shape[1])
        flat = rows - own_level
        flat *= own_scale
        flat = flat.reshape(layer.shape)
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
    mixed = np.empty((len(COLOURS), len(matched), *by_site.shape[1:]), dtype=np.complex64)
    for colour, own in enumerate(mixed):
        sites = np.flatnonzero(channels == colour)
        if len(sites) == 0:
            own[:] = 0
            continue
        np.multiply(matched[:, sites[0]], by_site[sites[0]], out=own)
        for site in sites[1:]:
            own += matched[:, site] * by_site[site]
    # Colours have much that cancels in their sum. In single precision, they are mixed before they become pictures.
    common = mixed.sum(axis=0)
    common *= np.float32(COMMON)
    mixed += common
    planes = joined_planes(mixed, cell, layout.columns)
    return cv2.transform(cv2.merge(list(planes)), np.column_stack([np.diag(COLOURFUL * noise_e), levels]))


def _chosen(
    whitened: Complex64[np.ndarray, "sites site_rows site_half"], tables: Tables, layout: TileLayout, pattern: Pattern
) -> np.float32:
    """Return the strength that a tile chooses."""
    return _likeliest(tables.costs(whitened, layout.power / (pattern.rows * pattern.columns)))


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
