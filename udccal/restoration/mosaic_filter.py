"""Demosaicing and deblurring in one linear filter per tile: the mean of the scene's posterior, given a tile's mosaic.

A mosaic of n sites per cell holds each frequency of a colour n times: as n sites, or as n aliases. Within a tile, with
one kernel per colour and normal distributions, the samples Y at one frequency of the site planes are

    Y = A X + noise,   cov X = s S,   cov noise = 1,   E[X | Y] = s S A^H (s B + 1)^-1 Y,   B = A S A^H,

where X holds the colours at the aliases of this frequency and A the kernels' transfer times each site's phase. S is the
scene's prior spectrum: power |f|^-3 with colours that mostly agree. With B = V^H diag(lambda) V, computed once per
profile, every strength s of the prior costs the same, and the probability of the tile's samples under each s is a sum
over V Y. So each tile chooses its own s, by maximum likelihood (Whittle, 1953).

Samples come in units of their noise. Then one table serves every brightness, exposure and colour of light.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex64, Complex128, Float, Float32, Float64
from scipy import fft

from udccal.cfa import Cfa
from udccal.restoration.lowrank import KernelGrid, interpolated_kernels
from udccal.restoration.tiles import TileLayout

_CHANNELS = 3
# Of the prior, fitted on photographs of two magnifications: the exponent of its power spectrum, the frequency in
# cycles/px below which it is flat, and the variance of a colour's deviation from grey relative to that of the grey.
_EXPONENT, _FLAT_BELOW, _COLOURFUL = 3.0, 0.003, 0.2
# Strengths of the prior in units of the noise: RMS difference of neighbours over the sigma of a sample, squared.
STRENGTHS = np.exp2(np.arange(-6.0, 17.0)).astype(np.float32)
# Every n-th frequency along both axes decides the strength.
_SPARSE = 3
_CHUNK = 6


@final
@dataclass(frozen=True)
class FilterTables:
    """What the filter needs of each tile's kernels.

    Attributes:
        matched: prior power times the conjugate transfer of each colour, at the tile's frequencies.
        vectors: V, orthonormal, by eigenvalue and site, at the site planes' frequencies.
        values: lambda, in units of the noise.
    """

    matched: Complex64[np.ndarray, "tiles 3 rows half"]
    vectors: Complex64[np.ndarray, "tiles sites sites site_rows site_half"]
    values: Float32[np.ndarray, "tiles sites site_rows site_half"]


def filter_tables(grid: KernelGrid, layout: TileLayout, cfa: Cfa, workers: int) -> FilterTables:
    """Compute the tables of every tile.

    Args:
        grid: kernels over the sensor.
        layout: the tiles.
        cfa: the colour pattern, whose cell divides the tiles.
        workers: threads.
    """
    kernels = interpolated_kernels(grid, layout.centres_px)
    density = prior_density(layout.rows, layout.columns)
    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(lambda kernel: _tables_of(kernel, density, cfa), kernels))
    return FilterTables(*(np.stack(column) for column in zip(*parts, strict=True)))


def prior_density(rows: int, columns: int) -> Float64[np.ndarray, "rows columns"]:
    """Return the prior's power spectrum at strength 1: its mean square difference of neighbours is 1."""
    y, x = np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(columns)
    power = (y**2 + x**2 + _FLAT_BELOW**2) ** (-_EXPONENT / 2)
    differences = 2 * (np.sin(np.pi * y) ** 2 + np.sin(np.pi * x) ** 2)
    return power / np.mean(power * differences)


def _tables_of(
    kernels: Float[np.ndarray, "3 ky kx"], density: Float64[np.ndarray, "rows columns"], cfa: Cfa
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, columns = density.shape
    transfer = _transfer(kernels, rows, columns)
    half = columns // cfa.columns // 2 + 1
    phases = np.array(_phases(rows, columns, cfa))
    channels = [site.channel for site in cfa.sites]
    seen = phases * transfer[channels]
    count = len(channels)
    matrix = np.empty((rows // cfa.rows, half, count, count), dtype=np.complex128)
    for i, own in enumerate(channels):
        for j, other in enumerate(channels[: i + 1]):
            product = density * seen[i] * np.conj(seen[j])
            folded = product.reshape(cfa.rows, rows // cfa.rows, cfa.columns, -1).sum(axis=(0, 2))[:, :half]
            matrix[..., i, j] = folded * (_agreement(own, other) / count)
            matrix[..., j, i] = np.conj(matrix[..., i, j])
    values, vectors = np.linalg.eigh(matrix)
    matched = (density * np.conj(transfer))[..., : columns // 2 + 1]
    return (
        matched.astype(np.complex64),
        np.conj(np.moveaxis(vectors, (3, 2), (0, 1))).astype(np.complex64),
        np.moveaxis(np.maximum(values, 0.0), 2, 0).astype(np.float32),
    )


def _transfer(
    kernels: Float[np.ndarray, "3 ky kx"], rows: int, columns: int
) -> Complex128[np.ndarray, "3 rows columns"]:
    """Return the Fourier transform of kernels whose origin is their middle; a larger kernel wraps around."""
    placed = np.zeros((_CHANNELS, rows, columns))
    ky, kx = kernels.shape[1:]
    at_y, at_x = (np.arange(ky) - ky // 2) % rows, (np.arange(kx) - kx // 2) % columns
    for plane, kernel in zip(placed, kernels, strict=True):
        np.add.at(plane, (at_y[:, None], at_x), kernel)
    return fft.fft2(placed)


def _phases(rows: int, columns: int, cfa: Cfa) -> list[Complex128[np.ndarray, "rows columns"]]:
    """Return exp(2 pi i f.p) for the place p of every site."""
    y, x = np.arange(rows)[:, None] / rows, np.arange(columns) / columns
    return [np.exp(2j * np.pi * (y * site.row + x * site.column)) for site in cfa.sites]


def _agreement(own: int, other: int) -> float:
    """Return the prior's covariance of two colours relative to the variance of grey."""
    return (1.0 if own == other else 0.0) * _COLOURFUL + 1.0 - _COLOURFUL / _CHANNELS


def filtered(
    tiles: Float32[np.ndarray, "tiles rows columns"],
    noise_e: Float32[np.ndarray, "tiles 3"],
    tables: FilterTables,
    layout: TileLayout,
    cfa: Cfa,
    workers: int,
    strengths: Float32[np.ndarray, "tiles"] | None = None,
) -> tuple[Float32[np.ndarray, "tiles 3 rows columns"], Float32[np.ndarray, " tiles"]]:
    """Demosaic and deblur tiles.

    Args:
        tiles: signal in e-, backscatter subtracted.
        noise_e: sigma of a sample of each colour in e-.
        tables: of the same tiles.
        layout: of the same tiles.
        cfa: the colour pattern.
        workers: threads.
        strengths: of each tile's prior; None to choose the likeliest.

    Returns:
        pictures in e-, and the strength of the prior that each tile chose, in units of its noise.
    """
    solve = partial(_solve_chunk, cfa=cfa)
    # One compilation serves both: a tile whose strength is given chooses among equal ones.
    choices = np.tile(STRENGTHS, (len(tiles), 1))
    if strengths is not None:
        choices[:] = strengths[:, None]
    chunks = [slice(start, start + _CHUNK) for start in range(0, len(tiles), _CHUNK)]

    def one(at: slice) -> tuple[np.ndarray, np.ndarray]:
        inputs = (tiles[at], noise_e[at], choices[at], tables.matched[at], tables.vectors[at], tables.values[at])
        missing = _CHUNK - len(inputs[0])
        if missing:  # One compilation serves the last chunk too.
            inputs = tuple(np.concatenate([part, np.repeat(part[-1:], missing, axis=0)]) for part in inputs)  # type: ignore[assignment]
        pictures, strengths = solve(*inputs, layout.taper)
        return np.asarray(pictures)[: _CHUNK - missing], np.asarray(strengths)[: _CHUNK - missing]

    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(one, chunks))
    return np.concatenate([p for p, _ in parts]), np.concatenate([s for _, s in parts])


@partial(jax.jit, static_argnames="cfa")
def _solve_chunk(
    tiles: Float32[Array, "tiles rows columns"],
    noise_e: Float32[Array, "tiles 3"],
    choices: Float32[Array, "tiles choices"],
    matched: Complex64[Array, "tiles 3 rows half"],
    vectors: Complex64[Array, "tiles sites sites site_rows site_half"],
    values: Float32[Array, "tiles sites site_rows site_half"],
    taper: Float32[Array, "rows columns"],
    cfa: Cfa,
) -> tuple[Float32[Array, "tiles 3 rows columns"], Float32[Array, " tiles"]]:
    every = (0, 0, 0, 0, 0, 0, None)
    return jax.vmap(partial(_solve, cfa=cfa), in_axes=every)(tiles, noise_e, choices, matched, vectors, values, taper)


def _solve(
    tile: Float32[Array, "rows columns"],
    noise_e: Float32[Array, "3"],
    choices: Float32[Array, " choices"],
    matched: Complex64[Array, "3 rows half"],
    vectors: Complex64[Array, "sites sites site_rows site_half"],
    values: Float32[Array, "sites site_rows site_half"],
    taper: Float32[Array, "rows columns"],
    cfa: Cfa,
) -> tuple[Float32[Array, "3 rows columns"], Float32[Array, ""]]:
    rows, columns = tile.shape
    planes = jnp.stack([tile[site.samples] for site in cfa.sites])
    channels = np.array([site.channel for site in cfa.sites])
    own = np.array([channels == channel for channel in range(_CHANNELS)])
    own = np.where(own.any(axis=1, keepdims=True), own, True) / np.maximum(own.sum(axis=1, keepdims=True), 1)
    level = jnp.asarray(own / own.sum(axis=1, keepdims=True), tile.dtype) @ planes.mean(axis=(1, 2))
    windows = jnp.stack([taper[site.samples] for site in cfa.sites])
    scaled = (planes - level[channels, None, None]) / noise_e[channels, None, None] * windows
    spectrum = (vectors * jnp.fft.rfft2(scaled)).sum(axis=1)
    strength = _likeliest(choices, spectrum, values, planes[0].size * jnp.mean(taper**2))
    weighted = (jnp.conj(vectors) * (strength / (strength * values + 1) * spectrum)[:, None]).sum(axis=0)
    whole = _whole_plane(weighted, rows, columns, cfa)
    phases = [jnp.conj(jnp.asarray(p[:, : columns // 2 + 1], matched.dtype)) for p in _phases(rows, columns, cfa)]
    at_site = [whole[index] * phase for index, phase in enumerate(phases)]
    per_colour = [
        sum(a for a, c in zip(at_site, channels, strict=True) if c == channel) for channel in range(_CHANNELS)
    ]
    by_colour = jnp.stack([matched[c] * part for c, part in enumerate(per_colour)])
    grey = by_colour.sum(axis=0) * (1 - _COLOURFUL / _CHANNELS)
    picture = jnp.fft.irfft2(_COLOURFUL * by_colour + grey, s=(rows, columns))
    return picture * noise_e[:, None, None] + level[:, None, None], strength


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


def _whole_plane(
    half: Complex64[Array, "sites site_rows site_half"], rows: int, columns: int, cfa: Cfa
) -> Complex64[Array, "sites rows half"]:
    """Return the site planes' spectra at every frequency of the tile's half plane: they repeat, once per alias."""
    across, down = columns // cfa.columns, rows // cfa.rows
    mirrored = jnp.conj(half[:, (-np.arange(down)) % down][:, :, (-np.arange(across // 2 + 1, across)) % across])
    period = jnp.concatenate([half, mirrored], axis=2)
    wide = period[:, :, np.arange(columns // 2 + 1) % across]
    return jnp.tile(wide, (1, cfa.rows, 1))
