"""The filter of all tiles at once, on a device: ``mosaic_filter``, ``clipped`` and ``tiles`` with fixed shapes.

Tables stay in single precision. At one frequency the eigenvalues span eight decades, and eigenvectors that are rounded
to 16 bits let the strongest part of the samples leak into the weakest, which the filter amplifies most: a picture is
ruined. Half of the tables' bytes would save an H100 some microseconds of a frame.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex64, Float, Int

from udccal.cfa import Cfa
from udccal.restoration.clipped import HALF, LEAST, ROUNDS, STEPS
from udccal.restoration.device.planes import along, apart, together
from udccal.restoration.mosaic_filter import COLOURFUL, COMMON, SPARSE, STRENGTHS, FilterTables
from udccal.restoration.sharpen import SPARSE as SPARSE_CELLS
from udccal.restoration.sharpen import tile_ends
from udccal.restoration.tiles import TileLayout

Mosaic = Float[Array, "rows columns"]
Tiles = Float[Array, "tiles tile_rows tile_columns"]
ByColour = Float[Array, "tiles 3"]
Spectrum = Complex64[Array, "tiles to y x"]
Matrix = Complex64[Array, "tiles to of y x"]


class Whitened(eqx.Module):
    """Tiles before the filter.

    Attributes:
        tiles: signal in e-. levels: mean of each colour in e-. noise_e: sigma of a sample of each colour.
        spectrum: samples in units of their noise, along the eigenvectors. strength: index of the likeliest strength.
    """

    tiles: Tiles
    levels: ByColour
    noise_e: ByColour
    spectrum: Spectrum
    strength: Int[Array, " tiles"]


class TileFilter(eqx.Module):
    """The tables of all tiles.

    Attributes:
        matched, vectors, values: as in ``FilterTables``.
        volume: sum of log(1 + s lambda) over the frequencies that decide the strength, by strength s.
        layout: of the tiles. cfa: the colour pattern.
    """

    matched: Matrix
    vectors: Matrix
    values: Float[Array, "tiles sites y x"]
    volume: Float[Array, "tiles strengths"]
    layout: TileLayout = eqx.field(static=True)
    cfa: Cfa = eqx.field(static=True)

    @classmethod
    def of(cls, tables: FilterTables, layout: TileLayout, cfa: Cfa) -> TileFilter:
        """Take over the tables of a layout's tiles."""
        some = tables.values[:, :, ::SPARSE, ::SPARSE]
        volume = np.stack([np.log1p(s * some).sum(axis=(1, 2, 3)) for s in STRENGTHS], axis=1)
        arrays = (jnp.asarray(each) for each in (tables.matched, tables.vectors, tables.values, volume))
        return cls(*arrays, layout, cfa)

    @property
    def cell(self) -> tuple[int, int]:
        """Rows and columns of the colour pattern's cell."""
        return self.cfa.rows, self.cfa.columns

    @property
    def channels(self) -> Int[np.ndarray, " sites"]:
        """Colour of each site."""
        return np.array([site.channel for site in self.cfa.sites])

    def cut(self, mosaic: Mosaic) -> Tiles:
        """Return the tiles as ``TileLayout.cut`` does."""
        layout = self.layout
        # What the layout does to coordinates tells where each sample of a tile comes from.
        y, x = (
            np.broadcast_to(each, mosaic.shape).astype(np.float32)
            for each in np.ogrid[: mosaic.shape[0], : mosaic.shape[1]]
        )
        rows = layout.by_place(layout.cut(y)[:, :, 0])[:, 0].astype(int).ravel()
        columns = layout.by_place(layout.cut(x)[:, 0])[0].astype(int).ravel()
        wide = jnp.take(jnp.take(mosaic, rows, axis=0), columns, axis=1)
        split = wide.reshape(len(layout.tops), layout.rows, len(layout.lefts), layout.columns)
        return jnp.swapaxes(split, 1, 2).reshape(layout.count, layout.rows, layout.columns)

    def join(self, pictures: Float[Array, "tiles 3 tile_rows tile_columns"]) -> Float[Array, "3 rows columns"]:
        """Blend the tiles' pictures as ``TileLayout.join`` does."""
        layout = self.layout
        wide = pictures.reshape(len(layout.tops), len(layout.lefts), 3, layout.rows, layout.columns)
        wide = jnp.moveaxis(wide, 2, 0).swapaxes(2, 3)
        picture = wide.reshape(3, len(layout.tops) * layout.rows, len(layout.lefts) * layout.columns)
        sizes = (layout.rows, layout.columns)
        for axis, strips, size, count in zip((-2, -1), layout.strips, sizes, layout.covered, strict=True):
            blend = np.zeros((count, len(strips) * size), np.float32)
            for index, strip in enumerate(strips):
                own = np.arange(index * size, (index + 1) * size)[strip.part]
                blend[np.arange(count)[strip.at], own] = strip.weights
            picture = along(blend, picture, axis)
        return picture

    def noise(self, variance_e2: Mosaic) -> ByColour:
        """Return the sigma of a sample of each colour in each tile, as ``Sharpener`` does."""
        layout = self.layout
        planes = apart(variance_e2, self.cell)[:, ::SPARSE_CELLS, ::SPARSE_CELLS]
        down, across = (
            _means(tile_ends(starts, size, most, count), count)
            for starts, size, most, count in (
                (layout.tops, layout.rows, layout.frame_rows, planes.shape[1]),
                (layout.lefts, layout.columns, layout.frame_columns, planes.shape[2]),
            )
        )
        of_site = (down @ planes @ across.T).reshape(len(planes), -1)
        return jnp.sqrt(jnp.maximum(self._by_colour(of_site), 1e-6)).T

    def _by_colour(self, of_site: Float[Array, "sites tiles"]) -> Float[Array, "3 tiles"]:
        """Return the mean of the sites of each colour; a colour without sites has the mean of all."""
        own = [self.channels == colour for colour in range(3)]
        return jnp.stack([of_site[mine if mine.any() else ~mine].mean(axis=0) for mine in own])

    def whitened(self, tiles: Tiles, noise_e: ByColour) -> Whitened:
        """Return the tiles' samples along the eigenvectors, and the strengths that they make likeliest."""
        planes, taper = apart(tiles, self.cell), apart(jnp.asarray(self.layout.taper), self.cell)
        levels = self._by_colour(planes.mean(axis=(-2, -1)).T).T
        flat = (planes - self._of_site(levels)) / self._of_site(noise_e) * taper
        spectrum = _product(self.vectors, jnp.fft.rfft2(flat))
        some, value = (each[:, :, ::SPARSE, ::SPARSE] for each in (spectrum, self.values))
        power = (some.real**2 + some.imag**2) / (np.sum(self.layout.taper**2) / np.prod(self.cell))
        variance = jnp.asarray(STRENGTHS)[:, None, None, None] * value[:, None] + 1
        cost = jnp.sum(power[:, None] / variance, axis=(2, 3, 4)) + self.volume
        return Whitened(tiles, levels, noise_e, spectrum, jnp.argmin(cost, axis=1))

    def _of_site(self, of_colour: ByColour) -> Float[Array, "tiles sites 1 1"]:
        return of_colour[:, self.channels, None, None]

    def pictures(self, found: Whitened, strengths: Float[Array, " tiles"]) -> Float[Array, "tiles 3 rows columns"]:
        """Return the posterior's mean in e- at some strengths of the prior."""
        weighted = found.spectrum / (self.values + 1 / strengths[:, None, None, None])
        by_site = _product(_adjoint(self.vectors), weighted)
        own = [np.flatnonzero(self.channels == colour).tolist() for colour in range(3)]
        spectra = [_product(self.matched, by_site, sites) if sites else jnp.zeros_like(by_site) for sites in own]
        common = (spectra[0] + spectra[1] + spectra[2]) * COMMON
        size = self.layout.rows // self.cfa.rows, self.layout.columns // self.cfa.columns
        planes = jnp.fft.irfft2(jnp.stack([each + common for each in spectra], axis=1), s=size)
        scale, level = (each[:, :, None, None] for each in (COLOURFUL * found.noise_e, found.levels))
        return together(planes, self.cell) * scale + level

    def completed(self, found: Whitened, clipped: Bool[Array, "rows columns"]) -> Whitened:
        """Complete clipped samples as ``clipped.completed`` does, where a tile has enough of them."""
        missing = self.cut(clipped.astype(jnp.float32)) > 0
        enough = jnp.count_nonzero(missing & (self.layout.taper > HALF), axis=(1, 2)) >= LEAST
        missing &= enough[:, None, None]
        return jax.lax.cond(jnp.any(enough), lambda: self._completed(found, missing), lambda: found)

    def _completed(self, found: Whitened, clipped: Bool[Array, "tiles tile_rows tile_columns"]) -> Whitened:
        planes, missing = apart(found.tiles, self.cell), apart(clipped, self.cell)
        taper = apart(jnp.asarray(self.layout.taper), self.cell)
        level, scale = planes.mean(axis=(-2, -1), keepdims=True), self._of_site(found.noise_e)
        weight = 1 / (jnp.asarray(STRENGTHS)[found.strength][:, None, None, None] * self.values + 1)

        def precision(of: Float[Array, "tiles sites _ _"]) -> Float[Array, "tiles sites _ _"]:
            own = _product(self.vectors, jnp.fft.rfft2(taper * of)) * weight
            return taper * jnp.fft.irfft2(_product(_adjoint(self.vectors), own), s=planes.shape[-2:])

        def step(_: Int[Array, ""], state: tuple[Array, ...]) -> tuple[Array, ...]:
            """One step of conjugate gradients; a tile that is solved, or nearly so, stays as it is."""
            value, free, rest, ahead, power, going = state
            change = precision(ahead) * free
            curvature = _inner(ahead, change)
            going &= (power > 0) & (curvature > 0)
            length = jnp.where(going, power / jnp.where(going, curvature, 1), 0)
            rest = rest - length * change
            after = _inner(rest, rest)
            turned = rest + jnp.where(going, after / jnp.where(going, power, 1), 0) * ahead
            return value + length * ahead, free, rest, turned, after, going

        least = (planes - level) / scale
        value, free = least, missing
        for _ in range(ROUNDS):
            rest = -precision(value) * free
            power = _inner(rest, rest)
            state = value, free, rest, rest, power, jnp.ones_like(power, bool)
            value = jnp.where(missing, jnp.maximum(jax.lax.fori_loop(0, STEPS, step, state)[0], least), least)
            free = missing & (value > least)
        tiles = together(jnp.where(missing, value * scale + level, planes), self.cell)
        return self.whitened(tiles, found.noise_e)


def _means(ends: Int[np.ndarray, "2 tiles"], count: int) -> Float[np.ndarray, "tiles samples"]:
    """Return the matrix that takes the mean of the samples of each tile along one axis."""
    at = np.arange(count)
    inside = (at >= ends[0][:, None]) & (at < ends[1][:, None])
    return (inside / inside.sum(axis=1, keepdims=True)).astype(np.float32)


def _inner(one: Float[Array, "tiles *n"], other: Float[Array, "tiles *n"]) -> Float[Array, "tiles 1 1 1"]:
    return jnp.sum(one * other, axis=(1, 2, 3), keepdims=True)


def _adjoint(matrix: Matrix) -> Matrix:
    return jnp.conj(jnp.swapaxes(matrix, 1, 2))


def _product(matrix: Matrix, spectrum: Spectrum, some: list[int] | None = None) -> Spectrum:
    """Return the product of a matrix and a vector at each frequency, of ``some`` of its columns."""
    columns = range(spectrum.shape[1]) if some is None else some
    parts = (matrix[:, :, column] * spectrum[:, None, column] for column in columns)
    return sum(parts, jnp.zeros((), jnp.complex64))
