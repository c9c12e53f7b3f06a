"""Noise taken out where a picture has no detail, band by band, with the noise that the filter is known to leave.

A filter with one strength per tile serves its strongest edges, and leaves noise beside them. So the filtered picture is
split into bands of scale and direction. In each, a sample keeps the part of its local energy that noise does not
explain (Wiener shrinkage; after a regularised filter it is ForWaRD: Neelamani, Choi and Baraniuk, IEEE Trans. Signal
Processing 52, 2004). The filter's noise in each band is measured once per profile, by filtering noise.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float32, Int

from udccal.cfa import Cfa
from udccal.restoration.mosaic_filter import STRENGTHS, FilterTables, filtered
from udccal.restoration.tiles import BLEND_PX, TAPER_PX, TileLayout

_LEVELS, _BANDS = 4, 3
# A sample keeps 1 - margin * noise / energy: the energy of noise alone scatters about its mean.
_MARGIN = 1.6
_WINDOW = (5, 5)
_SMOOTH = np.array([1, 4, 6, 4, 1], dtype=np.float32) / np.float32(16)
_ONE = np.ones(1, dtype=np.float32)
# Grey, red against blue, green against both; orthonormal.
_OPPONENT = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]], dtype=np.float32)
_OPPONENT /= np.linalg.norm(_OPPONENT, axis=1, keepdims=True)
# Tiles whose noise is measured, down and across the frame; the others are like the nearest of them.
_PROBES = 3

Plane = Float32[np.ndarray, "rows columns"]


@final
@dataclass(frozen=True)
class BandNoise:
    """Variance that unit noise of the samples leaves in each band.

    Attributes:
        variance: by probed tile, strength of the prior, opponent colour, level and band.
        probe: which probed tile stands for each tile.
    """

    variance: Float32[np.ndarray, "probes strengths 3 levels bands"]
    probe: Int[np.ndarray, " tiles"]

    def of_tiles(self, strengths: Float32[np.ndarray, " tiles"]) -> Float32[np.ndarray, "tiles 3 levels bands"]:
        """Return the variances of each tile at the strength that it chose."""
        return self.variance[self.probe, np.searchsorted(STRENGTHS, strengths)]


def measured_noise(tables: FilterTables, layout: TileLayout, cfa: Cfa, workers: int) -> BandNoise:
    """Filter noise at every strength of the prior, and measure what is left of it in each band.

    Args:
        tables: of the tiles.
        layout: of the tiles.
        cfa: the colour pattern.
        workers: threads.
    """
    down, across = len(layout.tops), len(layout.lefts)
    rows, columns = _probes(down), _probes(across)
    nearest_row = rows[np.abs(np.arange(down)[:, None] - rows).argmin(axis=1)]
    nearest_column = columns[np.abs(np.arange(across)[:, None] - columns).argmin(axis=1)]
    chosen, probe = np.unique(nearest_row[:, None] * across + nearest_column, return_inverse=True)
    repeated = np.repeat(chosen, len(STRENGTHS))
    noise = np.random.default_rng(0x5EED).standard_normal((len(chosen), layout.rows, layout.columns), dtype=np.float32)
    tiles = np.repeat(noise, len(STRENGTHS), axis=0)
    picked = FilterTables(tables.matched[repeated], tables.vectors[repeated], tables.values[repeated])
    unit = np.ones((len(tiles), 3), dtype=np.float32)
    pictures, _ = filtered(tiles, unit, picked, layout, cfa, workers, np.tile(STRENGTHS, len(chosen)))
    inner = slice(TAPER_PX + BLEND_PX, -TAPER_PX - BLEND_PX)
    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(lambda picture: _band_variances(picture[:, inner, inner]), pictures))
    return BandNoise(np.stack(parts).reshape(len(chosen), len(STRENGTHS), 3, _LEVELS, _BANDS), probe.reshape(-1))


def _probes(count: int) -> Int[np.ndarray, " probes"]:
    return np.unique(np.linspace(0, count - 1, _PROBES).round().astype(int))


def _band_variances(picture: Float32[np.ndarray, "3 rows columns"]) -> Float32[np.ndarray, "3 levels bands"]:
    found = np.zeros((3, _LEVELS, _BANDS), dtype=np.float32)
    for colour, plane in enumerate(np.tensordot(_OPPONENT, picture, 1)):
        rest = np.ascontiguousarray(plane)
        for level in range(_LEVELS):
            bands, smooth = _split(rest)
            found[colour, level] = [float(np.mean(band**2)) for band in bands]
            rest = cv2.resize(smooth, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_NEAREST)
    return found


def shrunk(
    picture: Float32[np.ndarray, "rows columns 3"],
    noise_e: Float32[np.ndarray, "tiles 3"],
    local_variance_e2: Float32[np.ndarray, "rows columns"],
    variance: Float32[np.ndarray, "tiles 3 levels bands"],
    layout: TileLayout,
    workers: int,
) -> Float32[np.ndarray, "rows columns 3"]:
    """Take noise out of a filtered picture.

    Args:
        picture: in e-, covered by the layout.
        noise_e: sigma of a sample of each colour, by tile.
        local_variance_e2: variance of a sample in e-^2, averaged over some px.
        variance: of unit noise in each band, by tile.
        layout: the tiles.
        workers: threads.
    """
    scale = np.stack([_smooth(layout, small, picture.shape[:2]) for small in layout.spread(noise_e)], axis=-1)
    opponent = (picture / scale) @ _OPPONENT.T
    # Within a tile, bright places are noisier than dark ones.
    brightness = local_variance_e2 / (scale * scale).mean(axis=-1)

    def one(colour: int) -> Plane:
        def noise(level: int, band: int, shape: tuple[int, ...]) -> Plane:
            small = next(layout.spread(variance[:, colour, level, band][:, None]))
            local = cv2.resize(brightness, shape[::-1], interpolation=cv2.INTER_AREA) if level else brightness
            return _stepped(layout, small, shape, 0.5**level) * local

        return _shrink_level(np.ascontiguousarray(opponent[..., colour]), 0, noise)

    with ThreadPoolExecutor(workers) as pool:
        calm = np.stack(list(pool.map(one, range(3))), axis=-1)
    return (calm @ _OPPONENT) * scale


def _shrink_level(plane: Plane, level: int, noise: Callable[[int, int, tuple[int, ...]], Plane]) -> Plane:
    """Shrink a plane's bands at this level, and at coarser ones by what they change."""
    bands, smooth = _split(plane)
    result = smooth.copy()
    for index, band in enumerate(bands):
        energy = cv2.blur(band * band, _WINDOW)
        keep = 1 - np.float32(_MARGIN) * noise(level, index, plane.shape) / np.maximum(energy, np.float32(1e-20))
        result += band * np.maximum(keep, np.float32(0))
    if level + 1 < _LEVELS and min(plane.shape) > 2 * len(_SMOOTH):
        half = cv2.resize(smooth, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_NEAREST)
        change = _shrink_level(half, level + 1, noise) - half
        result += cv2.resize(change, plane.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return result


def _split(plane: Plane) -> tuple[tuple[Plane, Plane, Plane], Plane]:
    """Split a plane into detail across, down and diagonal, and what is smooth; their sum is the plane."""
    border = cv2.BORDER_REFLECT_101
    down = cv2.sepFilter2D(plane, cv2.CV_32F, _ONE, _SMOOTH, borderType=border)
    across = cv2.sepFilter2D(plane, cv2.CV_32F, _SMOOTH, _ONE, borderType=border)
    smooth = cv2.sepFilter2D(down, cv2.CV_32F, _SMOOTH, _ONE, borderType=border)
    return (down - smooth, across - smooth, plane - down - across + smooth), smooth


def _stepped(
    layout: TileLayout, small: Float32[np.ndarray, "down across"], shape: tuple[int, ...], factor: float
) -> Plane:
    """Return each tile's value where the frame, or a smaller copy, comes from it; in blends, the largest."""
    result = np.zeros(shape, dtype=np.float32)
    for side_y, side_x in itertools.product((-0.5, 0.5), repeat=2):
        down = _tile_coordinate(layout, 0, shape[0], factor, side_y * BLEND_PX)
        across = _tile_coordinate(layout, 1, shape[1], factor, side_x * BLEND_PX)
        y, x = (
            np.clip(np.rint(at), 0, most - 1).astype(int) for at, most in zip((down, across), small.shape, strict=True)
        )
        np.maximum(result, small[y[:, None], x], out=result)
    return result


def _smooth(layout: TileLayout, small: Float32[np.ndarray, "down across"], shape: tuple[int, ...]) -> Plane:
    """Interpolate one value per tile linearly to the frame, constant beyond the outer tiles' centres."""
    down, across = (_tile_coordinate(layout, axis, shape[axis], 1.0, 0.0) for axis in (0, 1))
    return _interpolated(_interpolated(small, down).T, across).T


def _tile_coordinate(
    layout: TileLayout, axis: int, count: int, factor: float, offset_px: float
) -> Float32[np.ndarray, " count"]:
    """Return where samples of the frame, or of a copy smaller by ``factor``, lie in units of tiles."""
    starts, size = ((layout.tops, layout.rows), (layout.lefts, layout.columns))[axis]
    step = starts[1] - starts[0] if len(starts) > 1 else 1
    px = np.arange(count, dtype=np.float32) / np.float32(factor) + np.float32(offset_px)
    return (px - np.float32(starts[0] + (size - 1) / 2)) / np.float32(step)


def _interpolated(
    values: Float32[np.ndarray, "tiles columns"], at: Float32[np.ndarray, " n"]
) -> Float32[np.ndarray, "n columns"]:
    """Interpolate rows linearly, constant beyond the first and the last."""
    at = np.clip(at, 0, len(values) - 1)
    low = np.minimum(at.astype(int), max(len(values) - 2, 0))
    part = (at - low)[:, None].astype(np.float32)
    return values[low] * (1 - part) + values[np.minimum(low + 1, len(values) - 1)] * part
