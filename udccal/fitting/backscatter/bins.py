"""Averages of frames as rates in blocks of sensor pixels, colour by colour, with the variance of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from udccal.cfa import cell_channels
from udccal.models.noise import Noise, variance_e
from udccal.sessions.store import Average

# Part of saturation from which a mean counts as clipped.
_CLIPPED = 0.98


@dataclass(frozen=True)
class Binned:
    """One shot on the term's grid by camera colour.

    Attributes:
        rate: e-/s above the black level, the dark signal included.
        shot: slope of the rate's variance by the rate, e-/s: what one electron in a bin amounts to.
        rest: variance that a rate of 0 has, (e-/s)^2: read and row noise, quantisation, dark current.
        clipped: bins in which a sample is clipped.
        exposure_s: of the shot.
        scatter: variance between the frames of the shot over what the noise model says; NaN where not known.
    """

    rate: Float[np.ndarray, "3 grid_rows grid_columns"]
    shot: Float[np.ndarray, "3 grid_rows grid_columns"]
    rest: Float[np.ndarray, "3 grid_rows grid_columns"]
    clipped: Bool[np.ndarray, "3 grid_rows grid_columns"]
    exposure_s: float
    scatter: float = float("nan")

    @property
    def variance(self) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Of the rate, taken at the rate that was measured."""
        return self.shot * np.maximum(self.rate, 0.0) + self.rest


@dataclass(frozen=True)
class Binning:
    """How averages become rates in bins: the noise of single samples, and the wire's map, which is divided out."""

    noise: Noise
    shading: Float[np.ndarray, "rows columns"]
    cfa: str
    step: int

    def of(self, average: Average, exposure_s: float) -> Binned:
        """An average in bins."""
        noise = self.noise
        gain = float(np.asarray(noise.K_DN_per_e))
        to_rate = 1.0 / (exposure_s * self.shading)
        signal_e = (average.mean - float(np.asarray(noise.black_DN))) / gain
        clipped = average.mean >= _CLIPPED * float(np.asarray(noise.saturation_DN))

        bins = Bins(self.cfa, self.step)
        expected = np.maximum(signal_e, 0.0) + self._rest_e2(exposure_s)
        per_frame = to_rate**2 / average.frames
        rest = bins.variance(per_frame * self._rest_e2(exposure_s)) + bins.row_variance(per_frame * self._row_e2())
        return Binned(
            rate=bins.mean(signal_e * to_rate),
            shot=bins.variance(to_rate / average.frames),
            rest=rest,
            clipped=bins.mean(clipped.astype(np.float64)) > 0,
            exposure_s=exposure_s,
            scatter=float(average.variance.mean(dtype=np.float64) / gain**2 / expected.mean()),
        )

    def _rest_e2(self, exposure_s: float) -> float:
        """Variance of a sample in the dark that it shares with no other, e-^2."""
        dark = float(np.asarray(variance_e(self.noise, np.zeros(()), np.float64(exposure_s))))
        return max(dark - self._row_e2(), 0.0)

    def _row_e2(self) -> float:
        """Variance that the samples of a row share, e-^2."""
        return float(np.asarray(self.noise.sigma_row_DN / self.noise.K_DN_per_e)) ** 2


@dataclass(frozen=True)
class Bins:
    """Averages of a mosaic over blocks of ``step`` x ``step`` (even) pixels, colour by colour.

    A sample of a colour stands for the 2 x 2 pixels around it and counts by the part of them inside the block: then
    every colour's average is of the block's centre, though its samples are not.
    """

    cfa: str
    step: int

    def mean(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Averages of the samples."""
        return self._sum(mosaic, 1, 1)

    def variance(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Variances of the averages from those of the samples, each by itself."""
        return self._sum(mosaic, 2, 2)

    def row_variance(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """The same where the samples of a row go up and down together."""
        return self._sum(mosaic, 2, 1)

    def _sum(self, mosaic: np.ndarray, row_power: int, column_power: int) -> Float[np.ndarray, "3 a b"]:
        sums = np.zeros((3, *(size // self.step for size in mosaic.shape)))
        cells = np.asarray(cell_channels(self.cfa))
        # A colour with two samples in a cell averages them.
        share = 1.0 / np.bincount(cells.ravel(), minlength=3) ** max(row_power, column_power)
        for (j, i), channel in np.ndenumerate(cells):
            part = mosaic[j::2, i::2].astype(np.float64)
            by_row = block_weights(part.shape[0], mosaic.shape[0] // self.step, self.step, j) ** row_power
            by_column = block_weights(part.shape[1], mosaic.shape[1] // self.step, self.step, i) ** column_power
            sums[channel] += share[channel] * (by_row @ part @ by_column.T)
        return sums


def block_weights(samples: int, blocks: int, step: int, first: int) -> Float[np.ndarray, "blocks samples"]:
    """Weights of the samples at ``first``, ``first`` + 2, ... px in the averages over blocks of ``step`` px.

    A sample covers one pixel to either side of it; what the sensor's edge cuts off, the others of the block take over.
    """
    centre = first + 2.0 * np.arange(samples)
    edge = step * np.arange(blocks)[:, None] - 0.5
    overlap = np.minimum(centre + 1, edge + step) - np.maximum(centre - 1, edge)
    weights = np.maximum(overlap, 0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
