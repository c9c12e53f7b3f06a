"""Backscatter of a panel whose picture is not known, to subtract: that of a white one, at a level for each colour.

Light only adds, so a frame is nowhere darker than its backscatter: its darkest places give the level. Diffraction
spreads light of bright places into these. Once a picture is deblurred, they are darker, and the level is lower.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float32

from udccal.cfa import Cfa
from udccal.models.noise import Noise
from udccal.restoration.linear import variance_floor_e2

# Side in samples of the blocks that give the level: large enough to average noise, small enough to find dark places.
BLOCK = 8
# Light of a block that noise hardly exceeds: so many sigma above its mean. Of that, the darkest places give the level.
SIGMAS = 3.5
PERCENTILE = 0.1
# Strips across the frame: the darkest one gives the level, so that a dark strip is found beside bright ones.
STRIPS = 12

Blocks = Float32[np.ndarray, "down across 3"]


def mask_mosaic(
    mask: Float32[np.ndarray, "half_rows half_columns 3"], cfa: Cfa, rows: int, columns: int
) -> Float32[np.ndarray, "rows columns"]:
    """Return the profile's mask, one value per cell and channel, at every sample of the mosaic in its own colour."""
    last_row, last_column = mask.shape[0] - 1, mask.shape[1] - 1
    cell_rows = np.minimum(np.arange(rows) // cfa.rows, last_row)[:, None]
    cell_columns = np.minimum(np.arange(columns) // cfa.columns, last_column)[None, :]
    return mask[cell_rows, cell_columns, cfa.channel_map(rows, columns)]


@final
@dataclass(frozen=True)
class PanelMask:
    """The mask of some rows of a frame.

    Attributes:
        white: backscatter of a white panel in e-/s.
        cfa: the camera's colour pattern.
        error: sigma of the light over the light, as the calibration states it; 0 when it does not.
    """

    white: Float32[np.ndarray, "rows columns"]
    cfa: Cfa
    error: float = 0.0

    def levels(
        self, signal_e: Float32[np.ndarray, "rows columns"], exposure_s: float, noise: Noise
    ) -> Float32[np.ndarray, "3"]:
        """Estimate each colour's level, from 0 to 1; 0 for a colour without samples.

        In each of 12 strips across the frame, the 0.1st percentile of frame over white panel is taken in blocks of
        8 x 8 samples; the level is the lowest strip's. Each block is taken 3.5 sigma of its noise brighter than it is:
        of some thousand blocks, the darkest are dark by noise. In a scene without dark places the level is too high, by
        at most the scene's own darkest places.

        Args:
            signal_e: signal in e-, divided by the wire.
            exposure_s: exposure time of the frame.
            noise: the noise term.
        """
        return self._highest(_by_colour(signal_e, self.cfa), self._blocks, exposure_s, noise)

    def rate(self, levels: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "rows columns"]:
        """Return the backscatter in e-/s at these levels."""
        rate = np.empty_like(self.white)
        for site in self.cfa.sites:
            rate[site.samples] = levels[site.channel] * self.white[site.samples]
        return rate

    def put_back(
        self,
        picture_e: Float32[np.ndarray, "some_rows columns 3"],
        levels: Float32[np.ndarray, "3"],
        first_row: int,
        exposure_s: float,
        noise: Noise,
    ) -> Float32[np.ndarray, "some_rows columns 3"]:
        """Return a deblurred picture with the light that was too much to subtract; the picture itself if none was.

        Args:
            picture_e: deblurred light in e-, backscatter subtracted.
            levels: at which it was.
            first_row: of the picture, among the rows of the mask.
            exposure_s: exposure time of the frame.
            noise: the noise term.
        """
        rows, columns = picture_e.shape[:2]
        white = self._blocks[first_row // BLOCK :][: max(rows // BLOCK, 1)]
        subtracted = np.float32(exposure_s) * levels * white
        seen = cv2.resize(picture_e, white.shape[1::-1], interpolation=cv2.INTER_AREA) + subtracted
        too_much = np.maximum(levels - self._highest(seen, white, exposure_s, noise), 0)
        if not too_much.any():
            return picture_e
        back = np.float32(exposure_s) * too_much * white
        return picture_e + cv2.resize(back, (columns, rows), interpolation=cv2.INTER_LINEAR)

    @functools.cached_property
    def _blocks(self) -> Blocks:
        return _by_colour(self.white, self.cfa)

    def _highest(self, seen_e: Blocks, white: Blocks, exposure_s: float, noise: Noise) -> Float32[np.ndarray, "3"]:
        """Return the highest levels that light in blocks allows."""
        levels, floor_e2 = np.zeros(3, dtype=np.float32), np.float32(variance_floor_e2(noise, exposure_s))
        for channel in {site.channel for site in self.cfa.sites}:
            of_block = min(BLOCK**2, self.white.size) / len(self.cfa.sites)
            samples = np.float32(of_block * sum(site.channel == channel for site in self.cfa.sites))
            seen, possible = seen_e[..., channel], white[..., channel]
            usable = possible > 0
            if usable.any():
                seen = seen + SIGMAS * np.sqrt((np.maximum(seen, 0) + floor_e2) / samples)
                ratio = seen[usable] / possible[usable]
                strips = np.array_split(ratio, min(STRIPS, ratio.size))
                lowest = min(np.percentile(strip, PERCENTILE) for strip in strips)
                levels[channel] = np.clip(lowest / exposure_s, 0.0, 1.0)
        return levels


def _by_colour(mosaic: Float32[np.ndarray, "rows columns"], cfa: Cfa) -> Blocks:
    """Return each colour's mean in blocks; 0 of a colour without samples."""
    down, across = (max(size // BLOCK, 1) for size in mosaic.shape)
    columns = (across * BLOCK if mosaic.shape[1] >= BLOCK else mosaic.shape[1]) // cfa.columns * cfa.columns
    cut = mosaic[: down * BLOCK, :columns]
    # A line of the sites of one row is a line of pixels with as many channels: no site has to be picked out.
    lines = [cut[row :: cfa.rows].reshape(-1, columns // cfa.columns, cfa.columns) for row in range(cfa.rows)]
    blocks = [cv2.resize(line, (across, down), interpolation=cv2.INTER_AREA) for line in lines]
    sites = np.concatenate([block.reshape(down, across, -1) for block in blocks], axis=2)
    colours = np.zeros((len(cfa.sites), 3), dtype=np.float32)
    for index, site in enumerate(cfa.sites):
        colours[index, site.channel] = 1
    return sites @ (colours / np.maximum(colours.sum(axis=0), 1))
