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

import functools
import itertools
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Protocol, final, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex64, Complex128, Float, Float32, Float64
from scipy import fft

from udccal.cfa import Site
from udccal.restoration.kernel_grid import KernelGrid, centred, interpolated_kernels
from udccal.restoration.tiles import TileLayout

# Of the prior, fitted on photographs of two magnifications: the exponent of its power spectrum, the frequency in
# cycles/px below which it is flat, and the variance of a colour's deviation from grey relative to that of the grey.
_EXPONENT, _FLAT_BELOW, _COLOURFUL = 3.0, 0.003, 0.2
# The prior's covariance of two colours relative to the variance of grey.
COLOURS = _COLOURFUL * np.eye(3) + 1 - _COLOURFUL / 3
# Strengths of the prior in units of the noise: RMS difference of neighbours over the sigma of a sample, squared.
STRENGTHS = np.exp2(np.arange(-6.0, 17.0)).astype(np.float32)
# Every n-th frequency along both axes decides the strength.
_SPARSE = 3
_CHUNK = 6


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


@final
class FilterTables(eqx.Module):
    """What the filter needs of each tile's kernels. Within jitted functions, its arrays are JAX's.

    Attributes:
        matched: transfer from each site plane of the mosaic to the picture's plane at each place of the cell: prior
            power times the conjugate transfer of the site's colour.
        vectors: V, orthonormal, by eigenvalue and site, at the site planes' frequencies.
        values: lambda, in units of the noise.
    """

    matched: Complex64[np.ndarray, "tiles places sites site_rows site_half"]
    vectors: Complex64[np.ndarray, "tiles sites sites site_rows site_half"]
    values: Float32[np.ndarray, "tiles sites site_rows site_half"]


def filter_tables(grid: KernelGrid, layout: TileLayout, pattern: Pattern, workers: int) -> FilterTables:
    """Compute the tables of every tile.

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
    return (
        _polyphase(fft.ifft2(density * np.conj(transfer)).real, pattern).astype(np.complex64),
        np.conj(np.moveaxis(vectors, (3, 2), (0, 1))).astype(np.complex64),
        np.moveaxis(np.maximum(values, 0.0), 2, 0).astype(np.float32),
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
    tables: FilterTables,
    layout: TileLayout,
    pattern: Pattern,
    workers: int,
    strengths: Float32[np.ndarray, "tiles"] | None = None,
) -> tuple[Float32[np.ndarray, "tiles 3 rows columns"], Float32[np.ndarray, " tiles"]]:
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
    # One compilation serves both: a tile whose strength is given chooses among equal ones.
    choices = np.tile(STRENGTHS, (len(tiles), 1))
    if strengths is not None:
        choices[:] = strengths[:, None]
    inputs = tiles, noise_e, choices, tables

    def one(start: int) -> tuple[np.ndarray, np.ndarray]:
        # One compilation serves the last chunk too: it repeats tiles.
        at = np.minimum(np.arange(start, start + _CHUNK), len(tiles) - 1)
        count = min(_CHUNK, len(tiles) - start)
        part = jax.tree.map(lambda array: array[start : start + count] if count == _CHUNK else array[at], inputs)
        pictures, chosen = _solve_chunk(*part, layout.taper, pattern=pattern)
        return np.asarray(pictures)[:count], np.asarray(chosen)[:count]

    chunks = range(0, len(tiles), _CHUNK)
    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(one, chunks))
    return np.concatenate([p for p, _ in parts]), np.concatenate([s for _, s in parts])


@partial(jax.jit, static_argnames="pattern")
def _solve_chunk(
    tiles: Float32[Array, "tiles *colours rows columns"],
    noise_e: Float32[Array, "tiles 3"],
    choices: Float32[Array, "tiles choices"],
    tables: FilterTables,
    taper: Float32[Array, "rows columns"],
    pattern: Pattern,
) -> tuple[Float32[Array, "tiles 3 rows columns"], Float32[Array, " tiles"]]:
    return jax.vmap(partial(_solve, taper=taper, pattern=pattern))(tiles, noise_e, choices, tables)


def _solve(
    tile: Float32[Array, "*colours rows columns"],
    noise_e: Float32[Array, "3"],
    choices: Float32[Array, " choices"],
    tables: FilterTables,
    taper: Float32[Array, "rows columns"],
    pattern: Pattern,
) -> tuple[Float32[Array, "3 rows columns"], Float32[Array, ""]]:
    """Solve one tile; its tables have no axis of tiles."""
    of_site = [tile] * len(pattern.sites) if tile.ndim == 2 else list(tile)
    planes = jnp.stack([whole[site.samples] for whole, site in zip(of_site, pattern.sites, strict=True)])
    windows = jnp.stack([taper[site.samples] for site in pattern.sites])
    channels = np.array([site.channel for site in pattern.sites])
    own = np.array([channels == colour for colour in range(COLOURS.shape[0])], dtype=np.float32)
    # A colour without sites is like the mean of all.
    of_all = np.where(own.any(axis=1, keepdims=True), own, 1)
    level = (of_all / of_all.sum(axis=1, keepdims=True)) @ planes.mean(axis=(1, 2))
    scaled = (planes - level[channels, None, None]) / noise_e[channels, None, None] * windows
    spectrum = (tables.vectors * jnp.fft.rfft2(scaled)).sum(axis=1)
    values = jnp.asarray(tables.values)
    strength = _likeliest(choices, spectrum, values, planes[0].size * jnp.mean(taper**2))
    weighted = strength / (strength * values + 1) * spectrum
    by_site = tables.matched * (jnp.conj(tables.vectors) * weighted[:, None]).sum(axis=0)
    by_colour = [[w * by_site[:, site] for site, w in enumerate(row)] for row in COLOURS[:, channels].tolist()]
    mixed = jnp.stack([functools.reduce(jnp.add, parts) for parts in by_colour])
    picture = _interleaved(jnp.fft.irfft2(mixed, s=planes.shape[1:]), pattern)
    return picture * noise_e[:, None, None] + level[:, None, None], strength


def _interleaved(
    planes: Float32[Array, "3 places site_rows site_columns"], pattern: Pattern
) -> Float32[Array, "3 rows columns"]:
    colours, _, rows, columns = planes.shape
    by_place = planes.reshape(colours, pattern.rows, pattern.columns, rows, columns)
    return by_place.transpose(0, 3, 1, 4, 2).reshape(colours, rows * pattern.rows, columns * pattern.columns)


def _likeliest(
    choices: Float32[Array, " choices"],
    spectrum: Complex64[Array, "sites site_rows site_half"],
    values: Float32[Array, "sites site_rows site_half"],
    samples: Float32[Array, ""],
) -> Float32[Array, ""]:
    """Return the prior's strength under which the spectrum is most probable."""
    some = (slice(None), slice(None, None, _SPARSE), slice(None, None, _SPARSE))
    power, value = jnp.abs(spectrum[some]) ** 2 / samples, values[some]
    variance = choices[:, None, None, None] * value + 1
    cost = (power / variance + jnp.log(variance)).sum(axis=(1, 2, 3))
    return choices[jnp.argmin(cost)]
