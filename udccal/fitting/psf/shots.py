"""What the psf fit works on: crops of merged LED pictures about the LED, on Bayer sites, with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from jaxtyping import Float, Int

from udccal.cfa import channel_map
from udccal.fitting.hdr.merge import HdrMerge
from udccal.models.noise import Noise

# Aims that lie this close together are shifts of one field position.
_GROUP_PX = 4.0
SEARCH_PX = 16


@dataclass(frozen=True)
class Shots:
    """Crops of one size, one per picture of the LED.

    Attributes:
        centre_px: (x, y) on the sensor of the LED's image, as known so far.
        origin_px: (x, y) on the sensor of the crop's middle sample.
        position: index of the field position that the shot belongs to.
        disc_px: diameter of the LED's image.
        rate: e-/s; weight: 1 / sigma^2 in (e-/s)^-2, 0 where nothing is known; channel: 0, 1, 2 for R, G, B.
        noise_per_rate: how fast sigma^2 grows with the rate, in e-/s: the sigma of a sample that noise has made
            darker is too small, and a fit that went by it would come out too dark.
    """

    centre_px: Float[np.ndarray, "shots 2"]
    origin_px: Int[np.ndarray, "shots 2"]
    position: Int[np.ndarray, " shots"]
    disc_px: Float[np.ndarray, " shots"]
    rate: Float[np.ndarray, "shots rows columns"]
    weight: Float[np.ndarray, "shots rows columns"]
    channel: Int[np.ndarray, "shots rows columns"]
    noise_per_rate: Float[np.ndarray, "shots rows columns"]

    @property
    def count(self) -> int:
        """Number of pictures."""
        return self.rate.shape[0]

    def offsets(self) -> Int[np.ndarray, "rows columns 2"]:
        """(x, y) of every sample from the crop's middle sample."""
        rows, columns = self.rate.shape[1:]
        y, x = np.mgrid[:rows, :columns]
        return np.stack([x - columns // 2, y - rows // 2], axis=-1)

    def pick(self, keep: np.ndarray) -> Shots:
        """The shots selected by an index or mask."""
        return Shots(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    def positions_px(self) -> Float[np.ndarray, "positions 2"]:
        """Mean place of the shots of every field position."""
        groups = range(int(self.position.max()) + 1)
        return np.stack([self.centre_px[self.position == g].mean(axis=0) for g in groups])


@dataclass(frozen=True)
class Crop:
    """One shot before it is stacked with the others; fields as in ``Shots``."""

    centre_px: Float[np.ndarray, "2"]
    origin_px: Int[np.ndarray, "2"]
    rate: Float[np.ndarray, "rows columns"]
    weight: Float[np.ndarray, "rows columns"]
    channel: Int[np.ndarray, "rows columns"]
    noise_per_rate: Float[np.ndarray, "rows columns"]


def cut_crop(
    merged: HdrMerge,
    corner_px: tuple[int, int],
    aim_px: tuple[float, float],
    cfa: str,
    half: tuple[int, int],
    noise_per_rate: Float[np.ndarray, "rows columns"] | None = None,
) -> Crop | None:
    """Crop of 2 * half + 1 samples (rows, columns) about the LED; what lies outside the region gets no weight.

    Args:
        merged: the merged bracket of one region.
        corner_px: (x, y) of the region's first sample; even.
        aim_px: where the LED was aimed at, on the sensor.
        cfa: pattern of the sensor.
        half: (rows, columns) to either side of the LED.
        noise_per_rate: see ``shot_noise``; without it the merged sigma is taken as it is.

    Returns:
        None when no light stands out from the noise near the aim.
    """
    rate = merged.rate_e_per_s
    weight = np.where(merged.used > 0, 1.0 / merged.sigma_e_per_s.astype(np.float64) ** 2, 0.0)
    place = _brightest(rate, weight, np.asarray(aim_px) - corner_px)
    if place is None:
        return None
    middle = np.round(place).astype(np.int64)
    return Crop(
        centre_px=place + corner_px,
        origin_px=middle + corner_px,
        rate=_window(rate, middle, half),
        weight=_window(weight, middle, half),
        channel=_window(channel_map(cfa, *rate.shape), middle, half),
        noise_per_rate=_window(np.zeros_like(rate) if noise_per_rate is None else noise_per_rate, middle, half),
    )


def shot_noise(merged: HdrMerge, noise: Noise) -> Float[np.ndarray, "rows columns"]:
    """How fast a merged sample's variance grows with its rate, in (e-/s)^2 per e-/s.

    Variance (r + d) u + f u^2 is that of one exposure of 1/u seconds, f being what a dark sample has; a bracket is
    taken for the single exposure that has its variance.
    """
    K, dark = float(np.asarray(noise.K_DN_per_e)), float(np.asarray(noise.dark_current_e_per_s))
    floor = float(np.asarray(noise.sigma_d_e)) ** 2 + (float(np.asarray(noise.q_DN)) / K) ** 2 / 12.0
    light, variance = np.maximum(merged.rate_e_per_s + dark, 0.0), merged.sigma_e_per_s**2
    slope = 2.0 * variance / (light + np.sqrt(light**2 + 4.0 * floor * variance))
    return np.where(merged.used > 0, slope, 0.0)


def stack(crops: list[Crop], aims_px: Float[np.ndarray, "shots 2"], disc_px: Float[np.ndarray, " shots"]) -> Shots:
    """Crops of one size together, grouped into field positions by where they were aimed."""
    return Shots(
        centre_px=np.stack([c.centre_px for c in crops]),
        origin_px=np.stack([c.origin_px for c in crops]),
        position=group(aims_px),
        disc_px=disc_px,
        rate=np.stack([c.rate for c in crops]),
        weight=np.stack([c.weight for c in crops]),
        channel=np.stack([c.channel for c in crops]),
        noise_per_rate=np.stack([c.noise_per_rate for c in crops]),
    )


def group(aims_px: Float[np.ndarray, "shots 2"]) -> Int[np.ndarray, " shots"]:
    """Index of the field position of each shot: aims within a few pixels of a position's first belong to it."""
    firsts: list[Float[np.ndarray, "2"]] = []
    index = np.zeros(len(aims_px), dtype=np.int64)
    for i, aim in enumerate(aims_px):
        near = [g for g, first in enumerate(firsts) if np.abs(aim - first).max() <= _GROUP_PX]
        index[i] = near[0] if near else len(firsts)
        if not near:
            firsts.append(aim)
    return index


def _brightest(
    rate: Float[np.ndarray, "rows columns"], weight: Float[np.ndarray, "rows columns"], aim: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "2"] | None:
    """(x, y) of the LED: centroid about the brightest 2 x 2 cell near the aim, or None when it is not there.

    A cell holds every colour, so that the mosaic does not steer the search; hot pixels are too narrow to win it.
    """
    known = np.where(weight > 0, rate, 0.0)
    cells = scipy.ndimage.uniform_filter(scipy.ndimage.median_filter(known, size=3) + 0.02 * known, size=3)
    y, x = np.mgrid[: rate.shape[0], : rate.shape[1]]
    near = (np.abs(x - aim[0]) <= SEARCH_PX) & (np.abs(y - aim[1]) <= SEARCH_PX)
    if not near.any():
        return None
    row, column = np.unravel_index(np.argmax(np.where(near, cells, -np.inf)), rate.shape)
    about = (np.abs(x - column) <= 2) & (np.abs(y - row) <= 2)
    signal = np.maximum(known[about], 0.0)
    noise = np.sqrt((1.0 / np.maximum(weight[about], 1e-300)).clip(max=1e24))
    if signal.max(initial=0.0) < 8.0 * np.median(noise) or signal.sum() <= 0:
        return None
    return np.array([np.average(x[about], weights=signal), np.average(y[about], weights=signal)])


def _window(values: np.ndarray, middle: Int[np.ndarray, "2"], half: tuple[int, int]) -> np.ndarray:
    """Cut about (x, y) ``middle``; zeros outside."""
    padded = np.pad(values, [(half[0], half[0]), (half[1], half[1])])
    x, y = int(middle[0]), int(middle[1])
    return padded[y : y + 2 * half[0] + 1, x : x + 2 * half[1] + 1]
