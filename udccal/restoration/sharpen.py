"""From a mosaic without backscatter to a sharp picture on the sensor, in tiles."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int

from udccal.cfa import Cfa, cfa_named
from udccal.restoration.blur import blurred
from udccal.restoration.clipped import clipped_tiles, completed, effort_of
from udccal.restoration.filter_tables import FilterTables, filter_tables
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.lamps import LampFinder, WithoutLamps
from udccal.restoration.mosaic_filter import filtered_and_joined
from udccal.restoration.network import refined, sharper
from udccal.restoration.plan import PlanOptions
from udccal.restoration.prepared import kept
from udccal.restoration.shrink import BandNoise, measured_noise, shrunk
from udccal.restoration.tiles import TileLayout, layout_for
from udccal.rig import RigDescription
from udccal.tiers import Tier

Mosaic = Float32[np.ndarray, "rows columns"]
Clipped = Bool[np.ndarray, "rows columns"]
Strip = Float32[np.ndarray, "covered_rows columns 3"]

# Every n-th cell of a tile gives the mean noise of its samples.
SPARSE_CELLS = 4
# Width in px over which the noise's variance is averaged to tell bright places of a tile from dark ones.
LOCAL_PX = 16


@final
@dataclass(frozen=True)
class Solved:
    """What the tiles' filters give.

    Attributes:
        tiles: of the signal, with their clipped samples completed.
        picture: in e-, of the rows that the layout covers.
        strengths: of each tile's prior, in units of its noise.
        noise_e: sigma of a sample of each colour, by tile.
    """

    tiles: list[Float32[np.ndarray, "tile_rows tile_columns"]]
    picture: Strip
    strengths: Float32[np.ndarray, " tiles"]
    noise_e: Float32[np.ndarray, "tiles 3"]


@final
@dataclass(frozen=True)
class Sharpener:
    """Everything that depends on kernels alone.

    Attributes:
        tier: how much is done.
        grid: kernels over the sensor.
        rig: the rig description.
        layout: the tiles.
        tables: of the filters, by kernel.
        noise: what the filters leave of noise; None for the tier fast, which does not take it out.
        options: options of the restoration.
    """

    tier: Tier
    grid: KernelGrid
    rig: RigDescription
    layout: TileLayout
    tables: FilterTables
    noise: BandNoise | None
    options: PlanOptions

    @classmethod
    def of(
        cls,
        grid: KernelGrid,
        rig: RigDescription,
        rows: tuple[int, int],
        tier: Tier,
        options: PlanOptions,
        keep: Path | None = None,
    ) -> Sharpener:
        """Prepare the filters of a tier.

        Args:
            grid: kernels over the sensor.
            rig: the rig description.
            rows: first row of the sensor that the view needs, and the row after the last one.
            tier: one that deblurs.
            options: options of the restoration.
            keep: folder that keeps tables and noise between starts; None to keep nothing.
        """
        camera, cfa = rig.camera, cfa_named(rig.camera.cfa)
        size = options.tile_rows, options.tile_columns
        layout = layout_for(camera.rows, camera.columns, (cfa.rows, cfa.columns), size, rows)
        source = grid, layout, cfa
        tables = kept(keep, FilterTables, source, lambda: filter_tables(*source, options.workers))
        noise = None
        if tier in (Tier.balanced, Tier.accurate):
            noise = kept(keep, BandNoise, source, lambda: measured_noise(tables, layout, cfa, options.workers))
        return cls(tier, grid, rig, layout, tables, noise, options)

    @property
    def cfa(self) -> Cfa:
        """The camera's colour pattern."""
        return cfa_named(self.rig.camera.cfa)

    @property
    def rows(self) -> slice:
        """Rows of the sensor that ``apply`` returns."""
        return slice(self.layout.first_row, self.layout.last_row)

    def apply(self, signal_e: Mosaic, variance_e2: Mosaic, clipped: Clipped) -> Strip:
        """Demosaic and deblur.

        Args:
            signal_e: signal in e-, divided by the wire, without backscatter, of the frame's rows ``layout.reach``.
            variance_e2: variance of its noise in e-^2.
            clipped: samples whose light was more than they say.

        Returns:
            the picture in e-, of the rows that the layout covers.
        """
        if self.tier is not Tier.accurate:
            return self._sharp(signal_e, variance_e2, clipped)
        dark = self.without_lamps(signal_e, variance_e2, clipped)
        return dark.put_back(self._sharp(dark.signal_e, variance_e2, dark.clipped), self.layout.inner)

    def without_lamps(self, signal_e: Mosaic, variance_e2: Mosaic, clipped: Clipped) -> WithoutLamps:
        """Take lamps beyond the range off a frame, as the tier ``accurate`` does. Arguments are those of ``apply``."""
        finder = LampFinder(self.grid, self.layout, self.tables, self.cfa, self.options.lamps)
        return finder.without(signal_e, self._tile_noise(variance_e2), clipped)

    def _sharp(self, signal_e: Mosaic, variance_e2: Mosaic, clipped: Clipped) -> Strip:
        found = self.solved(signal_e, variance_e2, clipped)
        if self.noise is None:
            return found.picture
        bands = self.noise.of_tiles(found.strengths)
        local = cv2.blur(variance_e2, (LOCAL_PX, LOCAL_PX), borderType=cv2.BORDER_REFLECT_101)[self.layout.inner]
        balanced = shrunk(found.picture, found.noise_e, local, bands, self.layout, self.options.workers)
        if self.tier is Tier.balanced:
            return balanced
        given = found.noise_e, local, bands, self.layout, self.options.network_views
        best = refined(balanced, found.picture, self._sharper(found), *given)
        return best + self._contradicted(best, signal_e, clipped, found.noise_e)

    @property
    def _given(self) -> tuple[FilterTables, TileLayout, Cfa]:
        return self.tables, self.layout, self.cfa

    def solved(self, signal_e: Mosaic, variance_e2: Mosaic, clipped: Clipped) -> Solved:
        """Demosaic and deblur as ``apply`` does, but take out no noise."""
        noise_e = self._tile_noise(variance_e2)
        tiles = self.layout.tiles(signal_e)
        for index, missing in zip(*clipped_tiles(clipped, self.layout), strict=True):
            tables, effort = self.tables.at(int(self.layout.kernel[index])), effort_of(self.tier)
            given = noise_e[index], tables, self.layout, self.cfa, effort
            tiles[index] = completed(tiles[index], missing, *given)
        return Solved(tiles, *filtered_and_joined(tiles, noise_e, *self._given), noise_e)

    def _sharper(self, found: Solved) -> Strip:
        """Filter again, with a stronger prior than the one that each tile chose."""
        return filtered_and_joined(found.tiles, found.noise_e, *self._given, sharper(found.strengths))[0]

    def _contradicted(
        self, picture: Strip, signal_e: Mosaic, clipped: Clipped, noise_e: Float32[np.ndarray, "tiles 3"]
    ) -> Strip:
        """Return what the samples say against a picture: the filter of what they have more or less than it gives.

        With it, the picture is the most probable one where its own error has the filter's prior, at the strength that
        is likeliest for what is left of each tile. A clipped sample speaks against a picture that is darker only.
        """
        expected, inner = blurred(picture, self.grid, self.layout), self.layout.inner
        channels = self.cfa.channel_map(*signal_e.shape)[inner]
        rest = np.zeros_like(signal_e)
        rest[inner] = signal_e[inner] - np.take_along_axis(expected, channels[..., None], axis=2)[..., 0]
        rest[clipped] = np.maximum(rest[clipped], 0.0)
        return filtered_and_joined(self.layout.tiles(rest), noise_e, *self._given)[0]

    def _tile_noise(self, variance_e2: Mosaic) -> Float32[np.ndarray, "tiles 3"]:
        """Return the sigma of a sample of each colour in each tile."""
        of_site = [
            _tile_means(variance_e2[site.samples][::SPARSE_CELLS, ::SPARSE_CELLS], self.layout)
            for site in self.cfa.sites
        ]
        channels = np.array([site.channel for site in self.cfa.sites])
        own = [channels == channel if channel in channels else channels >= 0 for channel in range(3)]
        found = np.stack([np.mean(np.array(of_site)[mine], axis=0) for mine in own], axis=1)
        return np.sqrt(np.maximum(found, 1e-6)).astype(np.float32)


def _tile_means(some: Float32[np.ndarray, "rows columns"], layout: TileLayout) -> Float64[np.ndarray, " tiles"]:
    """Return the mean of each tile's part of the frame; ``some`` are samples at even steps over the strip."""
    sums = cv2.integral(np.ascontiguousarray(some))
    (top, bottom), (left, right) = tile_ends(layout, some.shape)
    total = sums[bottom][:, right] - sums[bottom][:, left] - sums[top][:, right] + sums[top][:, left]
    return (total / np.outer(bottom - top, right - left)).ravel()


def tile_ends(
    layout: TileLayout, shape: tuple[int, ...]
) -> tuple[Int[np.ndarray, "2 tiles_down"], Int[np.ndarray, "2 tiles_across"]]:
    """Return the first row of each tile and the one after its last, and its columns, among so many over the strip."""
    reach = layout.reach
    tops = tuple(top - reach.start for top in layout.tops)
    return (
        _ends(tops, layout.rows, reach.stop - reach.start, shape[0]),
        _ends(layout.lefts, layout.columns, layout.frame_columns, shape[1]),
    )


def _ends(starts: tuple[int, ...], size: int, most: int, count: int) -> Int[np.ndarray, "2 starts"]:
    """Return the first of ``count`` samples of each tile along one axis of ``most`` px, and the one after its last."""
    ends = np.clip(np.array([starts, [start + size for start in starts]]), 0, most) * count / most
    first = np.minimum(np.floor(ends[0]), count - 1)
    return np.array([first, np.maximum(np.ceil(ends[1]), first + 1)]).astype(int)
