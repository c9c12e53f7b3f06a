"""Samples that carry no information about the scene, replaced by what their neighbours say.

Where the wire passes next to nothing, a sample has noise and no light; divided by the wire, the noise outshines the
scene. A dead row of the sensor has no light either. Deblurring would spread what such samples say over their tile. So
each of them gets the light that the nearest samples of its site above and below it have, and the noise of that light.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, UInt16

from udccal.cfa import Cfa
from udccal.models.noise import Noise, dark_DN, scalar
from udccal.restoration.linear import least_saturated_DN

# A sample that passes less than this part of the mean light is blind; so is a row that has less of its neighbours'.
LEAST_PART: Final = 0.02
# Dead rows of one site that may lie together. A wider band without light may be part of the scene.
_MOST_DEAD: Final = 4
# A row is dead where its neighbours are brighter by so many sigma of a row's mean.
_SIGMAS: Final = 8.0

Mosaic = Float32[np.ndarray, "rows columns"]


@final
@dataclass(frozen=True)
class _Substitutes:
    """What stands in for blind samples.

    Attributes:
        at: their indices in the mosaic.
        sources: indices of the samples above and below them.
        weights: of the light of these.
    """

    at: Int[np.ndarray, " blind"]
    sources: Int[np.ndarray, "2 blind"]
    weights: Float64[np.ndarray, "2 blind"]


@final
@dataclass(frozen=True)
class BlindSamples:
    """The blind samples of some rows of a sensor.

    Attributes:
        wire: of these rows, at its blind samples as their neighbours have it; None when it is 1 everywhere.
        blind: samples to which the wire passes next to nothing.
        cfa: the colour pattern, whose cell begins with the first of these rows.
        noise: the noise term.
    """

    wire: Mosaic | None
    blind: Bool[np.ndarray, "rows columns"]
    cfa: Cfa
    noise: Noise

    @classmethod
    def of(cls, wire: Mosaic | None, shape: tuple[int, int], cfa: Cfa, noise: Noise) -> BlindSamples:
        """Find the samples to which the wire passes less than 2 % of its mean.

        Args:
            wire: of some rows of the sensor; None when it is 1 everywhere.
            shape: rows and columns.
            cfa: the colour pattern, whose cell begins with the first of these rows.
            noise: the noise term.
        """
        if wire is None:
            return cls(None, np.zeros(shape, dtype=bool), cfa, noise)
        blind = wire < LEAST_PART * wire.mean()
        if not blind.any():
            return cls(wire, blind, cfa, noise)
        found, filled = _substitutes(blind, cfa), wire.copy()
        filled.flat[found.at] = (found.weights * wire.ravel()[found.sources]).sum(axis=0)
        return cls(filled, blind, cfa, noise)

    def mended(self, mosaic: UInt16[np.ndarray, "rows columns"], exposure_s: float) -> UInt16[np.ndarray, "_ _"]:
        """Return these rows of a frame with their blind samples replaced; the rows themselves where there are none.

        Args:
            mosaic: the rows, in DN.
            exposure_s: exposure time of the frame.
        """
        dark = dark_DN(self.noise, exposure_s)
        found = self._found(tuple(np.flatnonzero(dead_rows(mosaic, self.noise, dark, self.cfa)).tolist()))
        if len(found.at) == 0:
            return mosaic
        sources, result, weights = mosaic.ravel()[found.sources], mosaic.copy(), found.weights
        if self.wire is not None:
            weights = weights * self.wire.flat[found.at] / self.wire.ravel()[found.sources]
        light = (weights * (sources - dark)).sum(axis=0)
        # What clips tells no more than that.
        most = scalar(self.noise.saturation_DN)
        light = np.where((sources >= least_saturated_DN(self.noise)).any(axis=0), most, np.clip(dark + light, 0, most))
        result.flat[found.at] = np.rint(light)
        return result

    @functools.cached_property
    def _found(self) -> functools._lru_cache_wrapper[_Substitutes]:
        """Substitutes of the wire's blind samples and of dead rows, which are the same in most frames."""

        def found(dead: tuple[int, ...]) -> _Substitutes:
            blind = self.blind.copy()
            blind[list(dead)] = True
            return _substitutes(blind, self.cfa)

        return functools.lru_cache(maxsize=2)(found)

    def __getstate__(self) -> dict[str, object]:
        """Leave out what is found anew: a cache cannot be pickled."""
        return {name: value for name, value in vars(self).items() if name != "_found"}


def dead_rows(
    mosaic: UInt16[np.ndarray, "rows columns"], noise: Noise, dark: float, cfa: Cfa
) -> Bool[np.ndarray, " rows"]:
    """Return the rows that have less than 2 % of the light of those above and below them.

    Args:
        mosaic: some rows of a frame in DN, which begin with a cell of the pattern.
        noise: the noise term.
        dark: what a sample reads without light, in DN.
        cfa: the colour pattern.
    """
    means = mosaic.sum(axis=1, dtype=np.uint64)[:, None] / mosaic.shape[1] - dark
    dead, window = np.zeros(len(mosaic), dtype=bool), np.ones((_MOST_DEAD + 1, 1), np.uint8)
    K = scalar(noise.K_DN_per_e)
    for first in range(cfa.rows):
        own = means[first :: cfa.rows]
        # A closing fills short gaps up to the lower of both sides; the sensor's border is no side.
        closed = cv2.morphologyEx(own, cv2.MORPH_CLOSE, window, borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,) * 4)
        shot = K * np.maximum(closed, 0.0) + (K * scalar(noise.sigma_d_e)) ** 2
        sigma = np.sqrt(scalar(noise.sigma_row_DN) ** 2 + shot / mosaic.shape[1])
        dead[first :: cfa.rows] = ((own < LEAST_PART * closed) & (closed > _SIGMAS * sigma))[:, 0]
    return dead


def _substitutes(blind: Bool[np.ndarray, "rows columns"], cfa: Cfa) -> _Substitutes:
    """Return what stands in for blind samples; a column without any others takes the nearest column that has some."""
    index = np.arange(blind.size).reshape(blind.shape)
    at, sources, weights = [], [], []
    for site in cfa.sites:
        own, own_index = blind[site.samples], index[site.samples]
        usable = np.flatnonzero(~own.all(axis=0))
        y, x = np.nonzero(own)
        if len(y) == 0 or len(usable) == 0:
            continue
        place = np.arange(len(own))[:, None]
        above = np.maximum.accumulate(np.where(own, -1, place), axis=0)
        below = np.minimum.accumulate(np.where(own, len(own), place)[::-1], axis=0)[::-1]
        nearest = usable[np.abs(usable[:, None] - np.arange(own.shape[1])).argmin(axis=0)][x]
        first, last = above[y, nearest], below[y, nearest]
        first, last = np.where(first < 0, last, first), np.where(last == len(own), first, last)
        part = np.where(first == last, 0.0, (y - first) / np.maximum(last - first, 1))
        at.append(own_index[y, x])
        sources.append(np.stack([own_index[first, nearest], own_index[last, nearest]]))
        weights.append(np.stack([1 - part, part]))
    if not at:
        return _Substitutes(np.empty(0, dtype=int), np.empty((2, 0), dtype=int), np.empty((2, 0)))
    return _Substitutes(np.concatenate(at), np.concatenate(sources, axis=1), np.concatenate(weights, axis=1))
