"""Noise taken out where a picture has no detail, band by band, with the noise that the filter is known to leave.

A filter with one strength per tile serves its strongest edges, and leaves noise beside them. So the filtered picture is
split into bands of scale and direction. In each, a sample keeps the part of its local energy that noise does not
explain (Wiener shrinkage; after a regularised filter it is ForWaRD: Neelamani, Choi and Baraniuk, IEEE Trans. Signal
Processing 52, 2004). The filter's noise in each band is measured once per profile, by filtering noise.
"""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeAlias, final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int
from scipy import sparse

from udccal.restoration.mosaic_filter import Pattern, Tables, filtered
from udccal.restoration.scene_prior import STRENGTHS
from udccal.restoration.tiles import Strip, TileLayout

LEVELS, BANDS = 4, 3
# A sample keeps 1 - margin * noise / energy: the energy of noise alone scatters about its mean.
MARGIN = 1.6
WINDOW = (5, 5)
SMOOTH = np.array([1, 4, 6, 4, 1], dtype=np.float32) / np.float32(16)
_ONE = np.ones(1, dtype=np.float32)
# Grey, red against blue, green against both; orthonormal.
OPPONENT = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]], dtype=np.float32)
OPPONENT /= np.linalg.norm(OPPONENT, axis=1, keepdims=True)
# Tiles whose noise is measured, down and across the frame; the others are like the nearest of them.
_PROBES = 3

# A row that takes the mean of three colours.
_MEAN = np.full((1, 3), 1 / 3, dtype=np.float32)

Plane: TypeAlias = Float32[np.ndarray, "rows columns"]


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


def measured_noise(
    tables: Tables,
    layout: TileLayout,
    pattern: Pattern,
    workers: int,
    strengths: Float32[np.ndarray, " strengths"] = STRENGTHS,
) -> BandNoise:
    """Filter noise at strengths of the prior, and measure what is left of it in each band.

    Args:
        tables: of the layout's kernels.
        layout: of the tiles.
        pattern: the colour pattern.
        workers: threads.
        strengths: some of ``STRENGTHS``, ascending; at the others nothing is measured, and the variance is 0.
    """
    down, across = len(layout.tops), len(layout.lefts)
    rows, columns = _probes(down), _probes(across)
    nearest_row = rows[np.abs(np.arange(down)[:, None] - rows).argmin(axis=1)]
    nearest_column = columns[np.abs(np.arange(across)[:, None] - columns).argmin(axis=1)]
    chosen, probe = np.unique(nearest_row[:, None] * across + nearest_column, return_inverse=True)
    repeated = np.repeat(chosen, len(strengths))
    # Sites that share a place have samples of their own.
    colours = len(pattern.sites) // (pattern.rows * pattern.columns)
    shape = (len(chosen), *(() if colours == 1 else (colours,)), layout.rows, layout.columns)
    noise = np.random.default_rng(0x5EED).standard_normal(shape, dtype=np.float32)
    tiles = np.repeat(noise, len(strengths), axis=0)
    unit = np.ones((len(tiles), 3), dtype=np.float32)
    own, repeated_strengths = tables.at(layout.kernel[repeated]), np.tile(strengths, len(chosen))
    pictures, _ = filtered(tiles, unit, own, layout, pattern, repeated_strengths)
    whole = tuple(slice(ends.both, -ends.both) for ends in (layout.down, layout.across))
    with ThreadPoolExecutor(workers) as pool:
        parts = list(pool.map(lambda picture: _band_variances(picture[whole]), pictures))
    variance = np.zeros((len(chosen), len(STRENGTHS), 3, LEVELS, BANDS), dtype=np.float32)
    variance[:, np.searchsorted(STRENGTHS, strengths)] = np.stack(parts).reshape(len(chosen), -1, 3, LEVELS, BANDS)
    return BandNoise(variance, probe.reshape(-1))


def _probes(count: int) -> Int[np.ndarray, " probes"]:
    return np.unique(np.linspace(0, count - 1, _PROBES).round().astype(int))


def _band_variances(picture: Float32[np.ndarray, "rows columns 3"]) -> Float32[np.ndarray, "3 levels bands"]:
    found = np.zeros((3, LEVELS, BANDS), dtype=np.float32)
    for colour, plane in enumerate(cv2.split(cv2.transform(picture, OPPONENT))):
        rest = plane
        for level in range(LEVELS):
            bands, smooth = split(rest)
            found[colour, level] = [float(np.mean(band**2)) for band in bands]
            rest = np.ascontiguousarray(smooth[::2, ::2])
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
        picture: in e-, the rows that the layout covers.
        noise_e: sigma of a sample of each colour, by tile.
        local_variance_e2: variance of a sample in e-^2, averaged over some px.
        variance: of unit noise in each band, by tile.
        layout: the tiles.
        workers: threads.
    """
    scale = interpolated(layout, layout.by_place(noise_e))
    opponent = cv2.transform(picture / scale, OPPONENT)
    # Within a tile, bright places are noisier than dark ones.
    brightness = [local_variance_e2 / (cv2.transform(scale * scale, _MEAN))]
    for _ in range(1, LEVELS):
        rows, columns = brightness[-1].shape
        brightness.append(cv2.resize(brightness[-1], (-(-columns // 2), -(-rows // 2)), interpolation=cv2.INTER_AREA))
    by_place = np.float32(MARGIN) * layout.by_place(variance)

    def one(colour: int) -> Plane:
        return _shrink_level(np.ascontiguousarray(opponent[..., colour]), by_place[:, :, colour], layout, brightness)

    with ThreadPoolExecutor(workers) as pool:
        calm = cv2.merge(list(pool.map(one, range(3))))
    return cv2.transform(calm, np.ascontiguousarray(OPPONENT.T)) * scale


def _shrink_level(
    plane: Plane,
    noise: Float32[np.ndarray, "tiles_down tiles_across levels bands"],
    layout: TileLayout,
    brightness: list[np.ndarray],
    level: int = 0,
) -> Plane:
    """Shrink a plane's bands at this level, and at coarser ones by what they change."""
    bands, smooth = split(plane)
    result = smooth.copy()
    down, across = (Runs.of(s, count, 0.5**level) for s, count in zip(layout.strips, plane.shape, strict=True))
    for index, band in enumerate(bands):
        energy = cv2.blur(band * band, WINDOW)
        energy += np.float32(1e-20)
        # 1 - noise / energy, in place: these are the passes over memory that cost most.
        keep = _largest(noise[:, :, level, index], down, across)
        keep *= brightness[level]
        keep /= energy
        np.subtract(np.float32(1), keep, out=keep)
        np.maximum(keep, np.float32(0), out=keep)
        keep *= band
        result += keep
    if level + 1 < LEVELS and min(plane.shape) > 2 * len(SMOOTH):
        half = np.ascontiguousarray(smooth[::2, ::2])
        change = _shrink_level(half, noise, layout, brightness, level + 1) - half
        result += cv2.resize(change, plane.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return result


def split(plane: Plane) -> tuple[tuple[Plane, Plane, Plane], Plane]:
    """Split a plane into detail across, down and diagonal, and what is smooth; their sum is the plane."""
    border = cv2.BORDER_REFLECT_101
    down = cv2.sepFilter2D(plane, cv2.CV_32F, _ONE, SMOOTH, borderType=border)
    across = cv2.sepFilter2D(plane, cv2.CV_32F, SMOOTH, _ONE, borderType=border)
    smooth = cv2.sepFilter2D(down, cv2.CV_32F, SMOOTH, _ONE, borderType=border)
    diagonal = plane - down
    diagonal -= across
    diagonal += smooth
    down -= smooth
    across -= smooth
    return (down, across, diagonal), smooth


@final
@dataclass(frozen=True)
class Runs:
    """Runs of samples along one axis of the picture, or of a smaller copy, that come from the same tiles.

    Attributes:
        first, last: tiles; two of them where they are blended.
        samples: length of each run.
    """

    first: Int[np.ndarray, " runs"]
    last: Int[np.ndarray, " runs"]
    samples: Int[np.ndarray, " runs"]

    @classmethod
    def of(cls, strips: list[Strip], count: int, factor: float) -> Runs:
        """Find the runs of ``count`` samples along an axis of a picture made smaller by ``factor``."""
        at = (np.arange(count) + 0.5) / factor
        first = np.searchsorted([strip.at.stop for strip in strips], at, side="right").clip(max=len(strips) - 1)
        last = np.searchsorted([strip.at.start for strip in strips], at, side="right") - 1
        begins = np.flatnonzero(np.diff(first, prepend=-1) | np.diff(last, prepend=-1))
        return cls(first[begins], last[begins], np.diff(begins, append=count))


def _largest(values: Float32[np.ndarray, "tiles_down tiles_across"], down: Runs, across: Runs) -> Plane:
    """Return the value of each sample's tile; of two tiles, the larger one."""
    rows = np.maximum(values[down.first], values[down.last])
    blocks = np.maximum(rows[:, across.first], rows[:, across.last])
    return np.repeat(np.repeat(blocks, across.samples, axis=1), down.samples, axis=0)


def interpolated(
    layout: TileLayout, values: Float32[np.ndarray, "tiles_down tiles_across planes"], step: int = 1
) -> Float32[np.ndarray, "rows columns *planes"]:
    """Interpolate values linearly between the tiles' centres, constant beyond the outer ones.

    Args:
        layout: the tiles.
        values: of each tile.
        step: px between the samples that are returned, of the rows that the layout covers. One plane has no axis.
    """
    down, across = hats(layout, step)
    return cv2.merge([down @ np.ascontiguousarray((across @ plane.T).T) for plane in np.moveaxis(values, -1, 0)])


@functools.lru_cache(maxsize=8)
def hats(layout: TileLayout, step: int) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Return the weights of both axes. They are sparse: BLAS would split such products among threads that spin."""
    down, across = (
        sparse.csr_array(linear_weights(np.array([strip.middle for strip in strips]), np.arange(0, count, step)))
        for strips, count in zip(layout.strips, layout.covered, strict=True)
    )
    return down, across


def linear_weights(
    nodes: Float[np.ndarray, " nodes"], at: Int[np.ndarray, " samples"]
) -> Float32[np.ndarray, "samples nodes"]:
    """Return the weights of linear interpolation from ``nodes`` to ``at``, constant beyond the outer ones."""
    return np.stack([np.interp(at, nodes, one) for one in np.eye(len(nodes))], axis=1).astype(np.float32)
