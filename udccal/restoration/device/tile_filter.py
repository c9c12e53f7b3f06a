"""The filter of all tiles at once, on a device: ``mosaic_filter``, ``clipped`` and ``tiles`` with fixed shapes.

Tables stay in single precision: eigenvectors of 16 bits ruin a picture (docs/restoration.md, "On a GPU").
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Complex64, Float, Int

from udccal.cfa import Cfa
from udccal.restoration.clipped import HALF, LEAST, Effort
from udccal.restoration.device.planes import Mosaic, apart, cut, joined, placing, together
from udccal.restoration.filter_tables import SPARSE
from udccal.restoration.mosaic_filter import LEVEL_ROWS, channels_of
from udccal.restoration.scene_prior import COLOURFUL, COMMON, STRENGTHS
from udccal.restoration.sharpen import SPARSE_CELLS, tile_ends
from udccal.restoration.tiles import TileLayout

Tiles = Float[Array, "tiles tile_rows tile_columns"]
ByColour = Float[Array, "tiles 3"]
Spectrum = Complex64[Array, "*tiles to y x"]
Matrix = Complex64[Array, "*tiles to of y x"]
Planes = Float[Array, "sites _ _"]


class Whitened(eqx.Module):
    """Tiles before the filter.

    Attributes:
        tiles: signal in e-. levels: about the mean of each colour in e-. noise_e: sigma of a sample of each colour.
        spectrum: samples in units of their noise, along the eigenvectors. strength: index of the likeliest strength.
    """

    tiles: Tiles
    levels: ByColour
    noise_e: ByColour
    spectrum: Spectrum
    strength: Int[Array, " tiles"]


class TileFilter(eqx.Module):
    """The tables of every tile's kernel.

    Attributes:
        matched, vectors, values: as in ``FilterTables``. layout: of the tiles. cfa: the colour pattern.
        effort: how long likelier values of clipped samples are looked for.
    """

    matched: Matrix
    vectors: Matrix
    values: Float[Array, "tiles sites y x"]
    layout: TileLayout = eqx.field(static=True)
    cfa: Cfa = eqx.field(static=True)
    effort: Effort = eqx.field(static=True)

    def join(self, pictures: Float[Array, "tiles 3 tile_rows tile_columns"]) -> Float[Array, "3 rows columns"]:
        """Blend the tiles' pictures as ``TileLayout.join`` does."""
        layout, blends = self.layout, []
        for strips, size, count in zip(layout.strips, (layout.rows, layout.columns), layout.covered, strict=True):
            starts = np.array([strip.at.start - strip.part.start for strip in strips])
            weights = [np.pad(strip.weights, (strip.part.start, size - strip.part.stop)) for strip in strips]
            blends.append(placing(starts, np.stack(weights), count))
        return joined(pictures, *blends)

    def noise(self, variance_e2: Mosaic) -> ByColour:
        """Return the sigma of a sample of each colour in each tile, as ``Sharpener`` does."""
        planes, means = apart(variance_e2, self.cfa)[:, ::SPARSE_CELLS, ::SPARSE_CELLS], []
        for (first, last), count in zip(tile_ends(self.layout, planes.shape[1:]), planes.shape[1:], strict=True):
            inside = (np.arange(count) >= first[:, None]) & (np.arange(count) < last[:, None])
            means.append((inside / inside.sum(axis=1, keepdims=True)).astype(np.float32))
        of_site = (means[0] @ planes @ means[1].T).reshape(len(planes), -1).T
        return jnp.sqrt(jnp.maximum(self._by_colour(of_site), 1e-6))

    def _by_colour(self, of_site: Float[Array, "tiles sites"]) -> ByColour:
        """Return the mean of the sites of each colour; a colour without sites has the mean of all."""
        own = [channels_of(self.cfa) == colour for colour in range(3)]
        return jnp.stack([of_site[:, mine if mine.any() else ~mine].mean(axis=1) for mine in own], axis=1)

    def _of_site(self, of_colour: ByColour) -> Float[Array, "tiles sites 1 1"]:
        return of_colour[:, channels_of(self.cfa), None, None]

    def whitened(self, tiles: Tiles, noise_e: ByColour) -> Whitened:
        """Return tiles along the eigenvectors, and the strengths that their samples make likeliest."""
        planes, taper = apart(tiles, self.cfa), apart(jnp.asarray(self.layout.taper), self.cfa)
        levels = self._by_colour(planes[:, :, ::LEVEL_ROWS].mean(axis=(2, 3)))
        flat = (planes - self._of_site(levels)) / self._of_site(noise_e) * taper
        spectrum = _product(self.vectors, jnp.fft.rfft2(flat))
        some, value = (each[:, :, ::SPARSE, ::SPARSE] for each in (spectrum, self.values))
        power = (some.real**2 + some.imag**2) / (self.layout.power / len(channels_of(self.cfa)))
        variance = jnp.asarray(STRENGTHS)[:, None, None, None] * value[:, None] + 1
        cost = jnp.sum(power[:, None] / variance + jnp.log(variance), axis=(2, 3, 4))
        return Whitened(tiles, levels, noise_e, spectrum, jnp.argmin(cost, axis=1))

    def pictures(self, found: Whitened, strengths: Float[Array, " tiles"]) -> Float[Array, "tiles 3 rows columns"]:
        """Return the posterior's mean in e- at some strengths of the prior."""
        weighted = found.spectrum / (self.values + 1 / strengths[:, None, None, None])
        by_site = _product(_adjoint(self.vectors), weighted)
        own = [np.flatnonzero(channels_of(self.cfa) == colour).tolist() for colour in range(3)]
        spectra = [_product(self.matched, by_site, sites) if sites else jnp.zeros_like(by_site) for sites in own]
        common = (spectra[0] + spectra[1] + spectra[2]) * COMMON
        size = self.layout.rows // self.cfa.rows, self.layout.columns // self.cfa.columns
        planes = jnp.fft.irfft2(jnp.stack([each + common for each in spectra], axis=1), s=size)
        scale, level = (each[:, :, None, None] for each in (COLOURFUL * found.noise_e, found.levels))
        return together(planes, self.cfa) * scale + level

    def completed(self, found: Whitened, clipped: Bool[Array, "rows columns"]) -> Whitened:
        """Complete clipped samples as ``clipped.completed`` does, where a tile has enough of them."""
        missing = cut(clipped.astype(jnp.float32), *self.layout.samples) > 0
        enough = jnp.sum(missing & (self.layout.taper > HALF), axis=(1, 2), keepdims=True) >= LEAST
        return jax.lax.cond(jnp.any(enough), lambda: self._completed(found, missing & enough), lambda: found)

    def _completed(self, found: Whitened, clipped: Bool[Array, "tiles tile_rows tile_columns"]) -> Whitened:
        planes, missing = apart(found.tiles, self.cfa), apart(clipped, self.cfa)
        taper = apart(jnp.asarray(self.layout.taper), self.cfa)
        level, scale = planes.mean(axis=(-2, -1), keepdims=True), self._of_site(found.noise_e)
        eigenvalues = 1 / (jnp.asarray(STRENGTHS)[found.strength][:, None, None, None] * self.values + 1)

        def one(least: Planes, missing: Bool[Array, "sites _ _"], vectors: Matrix, weight: Planes) -> Planes:
            def precision(of: Planes) -> Planes:
                own = _product(vectors, jnp.fft.rfft2(taper * of)) * weight
                return taper * jnp.fft.irfft2(_product(_adjoint(vectors), own), s=least.shape[1:])

            def likelier(value: Planes, free: Bool[Array, "sites _ _"]) -> Planes:
                change, _ = cg(lambda of: free * precision(of), -precision(value) * free, maxiter=self.effort.steps)
                return jnp.where(missing, jnp.maximum(value + change, least), least)

            value = likelier(least, missing)
            for _ in range(1, self.effort.rounds):
                value = likelier(value, missing & (value > least))
            return value

        value = jax.vmap(one)((planes - level) / scale, missing, self.vectors, eigenvalues)
        tiles = together(jnp.where(missing, value * scale + level, planes), self.cfa)
        return self.whitened(tiles, found.noise_e)


def _adjoint(matrix: Matrix) -> Matrix:
    return jnp.conj(jnp.swapaxes(matrix, -4, -3))


def _product(matrix: Matrix, spectrum: Spectrum, some: list[int] | None = None) -> Spectrum:
    """Return the product of a matrix and a vector at each frequency, of ``some`` of its columns."""
    columns = range(spectrum.shape[-3]) if some is None else some
    parts = (matrix[..., column, :, :] * spectrum[..., None, column, :, :] for column in columns)
    return sum(parts, jnp.zeros((), jnp.complex64))
