"""How sure the wire's map is, pixel by pixel, from the covariance of all that was fitted together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import jax
import numpy as np
from jaxtyping import Float

from udccal.fitting.wire.basis import BLOCK, SITES, Basis, Pixels, model_columns
from udccal.fitting.wire.joint import Joint
from udccal.models.geometry import unproject
from udccal.models.wire import Wire, scaled_positions
from udccal.numerics import in_float64

_GRID = (48, 64)


@final
@dataclass(frozen=True)
class MapSigma:
    """The wire map's uncertainty: ``factor factor^T`` is the covariance of what was fitted.

    Attributes:
        wire: as fitted, its map's mean 1.
        basis: the linear columns that were fitted; the ten shape parameters follow where ``shape``.
        factor: some hundred numbers square.
        mean_slope: of the map's mean, by what was fitted: the map is scaled to a mean of 1.
        model: relative error that the model itself may have, tile by tile of the sensor.
        rows, columns: of the sensor.
    """

    wire: Wire
    basis: Basis
    shape: bool
    factor: Float[np.ndarray, "n n"]
    mean_slope: Float[np.ndarray, " n"]
    model: Float[np.ndarray, "tiles_y tiles_x"]
    rows: int
    columns: int

    @in_float64
    def at(self, pixels: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, " places"]:
        """One standard deviation of the map at these pixels (x, y)."""
        value, slope = map_slopes(self.wire, self.basis, self.shape, pixels, self.rows, self.columns)
        slope = slope - value[:, None] * self.mean_slope
        across, down = (
            np.clip((pixels[:, i] + 0.5) / size * count, 0, count - 1).astype(np.int64)
            for i, (size, count) in enumerate(zip((self.columns, self.rows), self.model.shape[::-1], strict=True))
        )
        model = self.model[down, across] * value
        return np.asarray(np.sqrt(np.sum((slope @ self.factor) ** 2, axis=1) + model**2))

    def rms(self) -> float:
        """Of the sigmas over the sensor."""
        return float(np.sqrt(np.mean(self.at(_grid(self.rows, self.columns)) ** 2)))


def _grid(rows: int, columns: int) -> Float[np.ndarray, "places 2"]:
    down, across = ((np.arange(n) + 0.5) / n * size - 0.5 for n, size in zip(_GRID, (rows, columns), strict=True))
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


def map_sigma(joint: Joint, wire: Wire, rows: int, columns: int) -> MapSigma:
    """The uncertainty of a joint fit's map.

    Args:
        joint: the fit.
        wire: its wire, scaled so that the map's mean is 1.
        rows, columns: of the sensor.
    """
    _, slope = map_slopes(wire, joint.basis, joint.shape, _grid(rows, columns), rows, columns)
    values, vectors = np.linalg.eigh((joint.cov + joint.cov.T) / 2)
    factor = vectors * np.sqrt(np.maximum(values, 0.0))
    return MapSigma(wire, joint.basis, joint.shape, factor, slope.mean(axis=0), np.zeros((1, 1)), rows, columns)


@in_float64
def map_slopes(
    wire: Wire, basis: Basis, shape: bool, pixels: Float[np.ndarray, "places 2"], rows: int, columns: int
) -> tuple[Float[np.ndarray, " places"], Float[np.ndarray, "places n"]]:
    """The map's values at pixels (x, y), and their slopes by the columns of the fit; site gains are not in the map."""
    values, found = [], []
    for start in range(0, len(pixels), BLOCK):
        some = pixels[start : start + BLOCK]
        # Whole blocks, so that what the fit compiled serves here.
        padded = np.resize(some, (BLOCK, 2)).astype(np.float64)
        part = _unmeasured(wire, padded, rows, columns)
        whole, base, design = model_columns(wire, part, basis, shape)
        design[basis.gains_at : basis.gains_at + SITES - 1] = 0.0
        values.append((whole * base)[: len(some)])
        found.append((design * base).T[: len(some)])
    size = basis.size + (10 if shape else 0)
    return np.concatenate([np.zeros(0), *values]), np.concatenate([np.zeros((0, size)), *found])


_unproject = jax.jit(unproject)


def _unmeasured(wire: Wire, pixels: Float[np.ndarray, "n 2"], rows: int, columns: int) -> Pixels:
    count = len(pixels)
    return Pixels(
        ideal=np.asarray(_unproject(wire.geometry, pixels)),
        scaled=np.asarray(scaled_positions(pixels, rows, columns)),
        site=np.zeros(count, dtype=np.int64),
        value=np.zeros(count),
        weight=np.zeros(count),
        place=np.full(count, -1),
    )
