"""How long a frame is expected to take at each tier, from a small measurement of this computer.

Every part of restoration is timed once on arrays of a small camera, per pixel. A frame takes the sum over its pixels.
The measurement is kept with what restoration prepares. A panel picture that stands still is summed once, so that it is
not part of a frame's time; nor are reading and writing files.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Bool, Float64

from udccal.cfa import Cfa, cfa_named
from udccal.compilation import processor_key
from udccal.models.noise import Noise
from udccal.restoration.clipped import QUICK, THOROUGH, Effort, clipped_tiles, completed
from udccal.restoration.defects import without_defects
from udccal.restoration.demosaic import demosaic
from udccal.restoration.filter_tables import FilterTables
from udccal.restoration.lamp_fit import Responses, lamp_light
from udccal.restoration.lamp_pieces import hidden_samples
from udccal.restoration.lamps import ROUNDS
from udccal.restoration.linear import to_electrons, variance_e2
from udccal.restoration.mosaic_filter import filtered_and_joined
from udccal.restoration.network import corrected, noise_planes
from udccal.restoration.panel_mask import PanelMask
from udccal.restoration.plan import PlanOptions
from udccal.restoration.prepared import kept
from udccal.restoration.preview import Preview
from udccal.restoration.rectify import Rectification
from udccal.restoration.shrink import shrunk
from udccal.restoration.tiles import TileLayout, layout_for
from udccal.restoration.tone import Tone
from udccal.tiers import Tier

_ROWS, _COLUMNS, _RUNS = 512, 768, 5
# Part of a tile's samples that clip; it hardly matters to their time. Radius of a lamp.
_CLIPPED, _LAMP_PX = 0.02, 7.0
# Of a frame's parts over the same measured alone, each of which then finds its arrays in the cache: the median of the
# scenes of docs/restoration.md at the tiers fast (1.20) and balanced (1.24).
_TOGETHER = 1.2

Seconds = Float64[np.ndarray, ""]


@final
@dataclass(frozen=True)
class PartTimes:
    """Seconds of each part of restoration per pixel.

    Attributes:
        linear: electrons, defects, variance, wire and backscatter, per pixel of the sensor.
        demosaicing: per pixel of the sensor.
        filter: of the tiles, per pixel of a tile.
        shrinkage: per pixel that the tiles cover.
        network: of the tier ``accurate``, per pixel that the tiles cover.
        view: resampling and tone, per pixel of the view.
        preview: all of a preview, per pixel of the rows that the view needs.
        completion: of clipped samples, per pixel of the tiles that have some. quick_completion: at the tier fast.
        lamp: of the tier ``accurate``, per piece of clipped samples that may be one.
    """

    linear: Seconds
    demosaicing: Seconds
    filter: Seconds
    shrinkage: Seconds
    network: Seconds
    view: Seconds
    preview: Seconds
    completion: Seconds
    quick_completion: Seconds
    lamp: Seconds


@final
@dataclass(frozen=True)
class FrameSize:
    """What a frame's time depends on.

    Attributes:
        strip_px: pixels of the rows that are worked on.
        covered_px: pixels of the rows that the view needs.
        view_px: pixels of the view.
        tile_px: pixels of all tiles; 0 where nothing is deblurred.
        clipped_px: pixels of the tiles in which samples clip.
        lamps: pieces of clipped samples that may be lamps.
    """

    strip_px: int
    covered_px: int
    view_px: int
    tile_px: int
    clipped_px: int
    lamps: int

    @classmethod
    def of(
        cls,
        layout: TileLayout,
        view_px: int,
        blurred: bool,
        clipped: Bool[np.ndarray, "strip_rows columns"],
        lamps: int,
    ) -> FrameSize:
        """Return the size of a frame in the tiles of ``layout``; ``clipped`` are samples of the rows ``reach``."""
        of_tile = layout.rows * layout.columns
        tile_px, clipped_px = layout.count * of_tile, len(clipped_tiles(clipped, layout)[0]) * of_tile
        strip_rows = layout.reach.stop - layout.reach.start if blurred else layout.frame_rows
        strip_px = strip_rows * layout.frame_columns
        covered_px = int(np.prod(layout.covered))
        if not blurred:
            return cls(strip_px, covered_px, view_px, 0, 0, 0)
        return cls(strip_px, covered_px, view_px, tile_px, clipped_px, lamps)

    def ms(self, tier: Tier, times: PartTimes) -> float:
        """Return the milliseconds from a raw frame to a picture of 8 bits at a tier."""
        if tier is Tier.preview:
            return 1e3 * float(self.covered_px * times.preview)
        seconds = self.strip_px * times.linear + self.view_px * times.view
        if self.tile_px == 0:
            return 1e3 * float(seconds + self.strip_px * times.demosaicing)
        completion = times.quick_completion if tier is Tier.fast else times.completion
        seconds = seconds + self.tile_px * times.filter + self.clipped_px * completion
        if tier in (Tier.balanced, Tier.accurate):
            seconds = seconds + self.covered_px * times.shrinkage
        seconds = _TOGETHER * seconds
        if tier is Tier.accurate:
            seconds = seconds + self.tile_px * times.filter + self.covered_px * times.network
            seconds = seconds + ROUNDS * self.lamps * times.lamp
        return 1e3 * float(seconds)


def part_times(options: PlanOptions, keep: Path | None = None) -> PartTimes:
    """Measure this computer, or read what an earlier start measured on such a processor with as many cores.

    Args:
        options: options of the restoration.
        keep: folder that keeps the measurement; None to keep nothing.
    """
    computer = processor_key(), os.cpu_count() or 1
    return kept(keep, PartTimes, (options, *computer), lambda: _measured(options))


def _measured(options: PlanOptions) -> PartTimes:
    rng, cfa, workers = np.random.default_rng(0x7135), cfa_named("RGGB"), options.workers
    noise = Noise(0.4, 64.0, 3969.0, 5.0, 0.1, 0.2, 1.0, 20.0, 2.0, 0.005)
    # An even frame with noise: without defects to look at, as most frames are.
    mosaic = (64 + 0.4 * rng.poisson(3000.0, (_ROWS, _COLUMNS))).astype(np.uint16)
    ones = np.ones(mosaic.shape, dtype=np.float32)
    layout = layout_for(_ROWS, _COLUMNS, (2, 2), (options.tile_rows, options.tile_columns), (0, _ROWS))
    view_y, view_x = np.mgrid[: _ROWS - 8, : _COLUMNS - 8].astype(np.float32) + np.float32(4.3)
    rectification, tone, mask = Rectification(view_x, view_y), Tone(1e-4), PanelMask(ones, cfa)
    preview = Preview.of(noise, ones, mask, cfa, rectification, mosaic.shape)
    signal = to_electrons(mosaic, noise, 1.0)
    tables, unit = _like_tables(layout, cfa, rng), np.full((layout.count, 3), 55.0, np.float32)
    bands = np.full((layout.count, 3, 4, 3), 0.1, np.float32)
    picture = demosaic(signal, cfa.name)

    def linear() -> None:
        clean = to_electrons(without_defects(mosaic, noise, 1.0, cfa.name, workers), noise, 1.0)
        variance = variance_e2(clean, noise, 1.0)
        clean /= ones
        variance /= ones
        variance /= ones
        clean -= np.float32(1.0) * ones

    given = unit, tables, layout, cfa
    tiles = layout.cut(signal)
    clipped = rng.random(tiles.shape[1:]) < _CLIPPED

    def completion(effort: Effort) -> None:
        for index in range(layout.count):
            completed(tiles[index], clipped, unit[index], tables.at(int(layout.kernel[index])), layout, cfa, effort)

    def network() -> None:
        planes = noise_planes(bands, unit, signal, layout)
        corrected(picture, picture, picture, picture, planes, options.network_views)

    disc = (
        np.hypot(*np.mgrid[: layout.rows, : layout.columns] - np.array([[[layout.rows]], [[layout.columns]]]) / 2)
        < _LAMP_PX
    )
    hidden, even = hidden_samples(disc), np.full(disc.shape, 10.0)
    start = np.full((3, np.count_nonzero(disc)), 100.0)
    kernels = np.full((3, 129, 33), 1 / (129 * 33))

    def lamp() -> None:
        responses = Responses.of(tables.at(0), np.float32(64), kernels, cfa, disc.shape)
        lamp_light(np.where(disc, 20.0, 0.0), even, hidden, ~disc, disc, start, responses)

    parts = (
        (linear, mosaic.size),
        (lambda: demosaic(signal, cfa.name), mosaic.size),
        (lambda: filtered_and_joined(layout.cut(signal), *given), tiles.size),
        (lambda: shrunk(picture, unit, signal, bands, layout, workers), mosaic.size),
        (network, mosaic.size),
        (lambda: tone.rgb8(rectification.apply(picture, options.interpolation)), view_x.size),
        (lambda: preview.rgb8(mosaic, 1.0, tone), mosaic.size),
        (lambda: completion(THOROUGH), tiles.size),
        (lambda: completion(QUICK), tiles.size),
        (lamp, 1),
    )
    return PartTimes(*(np.array(_least_s(run) / pixels) for run, pixels in parts))


def _like_tables(layout: TileLayout, cfa: Cfa, rng: np.random.Generator) -> FilterTables:
    """Return tables of the right shapes; the numbers do not matter to their time."""
    sites = len(cfa.sites)
    planes = layout.rows // cfa.rows, layout.columns // cfa.columns // 2 + 1
    square = rng.standard_normal((layout.kernel[-1] + 1, sites, sites, *planes)).astype(np.complex64)
    return FilterTables(square, square, np.abs(square[:, 0]).astype(np.float32))


def _least_s(run: Callable[[], object]) -> float:
    """Return the least seconds of some runs: other programs only add."""
    run()  # compiles
    seconds = []
    for _ in range(_RUNS):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return min(seconds)
