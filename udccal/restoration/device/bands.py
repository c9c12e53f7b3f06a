"""Noise taken out band by band on a device, as ``shrink`` does it."""

from __future__ import annotations

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udccal.restoration.device.planes import box_mean, convolved, resized
from udccal.restoration.shrink import BANDS, LEVELS, MARGIN, OPPONENT, SMOOTH, WINDOW, BandNoise, Runs, linear_weights
from udccal.restoration.tiles import TileLayout

Planes = Float[Array, "3 rows columns"]
Local = Float[Array, "rows columns"]


class Bands(eqx.Module):
    """``BandNoise`` on a device.

    Attributes:
        variance: by probed tile and strength. probe: which one stands for each tile. layout: of the tiles.
    """

    variance: Float[Array, "probes strengths 3 levels bands"]
    probe: Int[Array, " tiles"]
    layout: TileLayout = eqx.field(static=True)

    @classmethod
    def of(cls, noise: BandNoise, layout: TileLayout) -> Bands:
        """Take over what a profile's filters leave."""
        return cls(jnp.asarray(noise.variance), jnp.asarray(noise.probe), layout)

    def of_tiles(self, strength: Int[Array, " tiles"]) -> Float[Array, "tiles 3 levels bands"]:
        """Return the variances of each tile at the strength of this index."""
        return self.variance[self.probe, strength]

    def shrunk(
        self, picture: Planes, noise_e: Float[Array, "tiles 3"], local_e2: Local, variance: Float[Array, "tiles 3 _ _"]
    ) -> Planes:
        """Take noise out of a filtered picture. Arguments are those of ``shrink.shrunk``."""
        scale = between(self.layout, noise_e)
        brightness = [local_e2 / jnp.mean(scale**2, axis=0)]
        for _ in range(1, LEVELS):
            brightness.append(halved(brightness[-1]))
        places = len(self.layout.tops), len(self.layout.lefts)
        by_place = jnp.moveaxis(MARGIN * variance, 0, -1).reshape(3, LEVELS, BANDS, *places)
        calm = self._level(_mixed(OPPONENT, picture / scale), by_place, brightness, 0)
        return _mixed(OPPONENT.T, calm) * scale

    def _level(
        self, planes: Planes, noise: Float[Array, "3 levels bands down across"], brightness: list[Array], level: int
    ) -> Planes:
        """Shrink the bands at this level, and at coarser ones by what they change."""
        down, across = convolved(planes, SMOOTH, -2), convolved(planes, SMOOTH, -1)
        smooth = convolved(down, SMOOTH, -1)
        shape, result = (planes.shape[1], planes.shape[2]), smooth
        for index, band in enumerate((down - smooth, across - smooth, planes - down - across + smooth)):
            energy = box_mean(band * band, WINDOW[0]) + 1e-20
            unexplained = 1 - self._largest(noise[:, level, index], shape, level) * brightness[level] / energy
            result += jnp.maximum(unexplained, 0) * band
        if level + 1 < LEVELS and min(shape) > 2 * len(SMOOTH):
            half = smooth[:, ::2, ::2]
            change = self._level(half, noise, brightness, level + 1) - half
            result += resized(change, shape, cv2.INTER_LINEAR)
        return result

    def _largest(self, values: Float[Array, "3 down across"], shape: tuple[int, int], level: int) -> Planes:
        """Return the value of each sample's tile; of two tiles, the larger one."""
        spread = []
        for axis, strips, count in zip((1, 2), self.layout.strips, shape, strict=True):
            runs = Runs.of(strips, count, 0.5**level)
            values = jnp.maximum(jnp.take(values, runs.first, axis=axis), jnp.take(values, runs.last, axis=axis))
            spread.append(np.repeat(np.eye(len(runs.samples), dtype=np.float32), runs.samples, axis=0))
        return jnp.einsum("yi,cij,xj->cyx", spread[0], values, spread[1])


def between(
    layout: TileLayout, values: Float[Array, "tiles planes"], step: int = 1
) -> Float[Array, "planes rows columns"]:
    """Interpolate values between the tiles' centres, as ``shrink.interpolated`` does."""
    down, across = (
        linear_weights(np.array([strip.middle for strip in strips]), np.arange(0, count, step))
        for strips, count in zip(layout.strips, layout.covered, strict=True)
    )
    return down @ values.T.reshape(-1, len(layout.tops), len(layout.lefts)) @ across.T


def halved(plane: Local) -> Float[Array, "half_rows half_columns"]:
    """Return the mean of every 2 x 2 samples; of an odd number of samples, of as many more as are needed."""
    rows, columns = plane.shape
    return resized(plane, (-(-rows // 2), -(-columns // 2)), cv2.INTER_AREA)


def _mixed(matrix: Float[np.ndarray, "3 3"], picture: Planes) -> Planes:
    # A product of matrices: XLA would compute what sums need anew for each of the three planes.
    return jnp.einsum("ij,jyx->iyx", matrix, picture)
