"""Backscatter of a panel whose picture is known, to subtract."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from scipy import sparse

from udccal.cfa import Cfa, cfa_named
from udccal.errors import PanelPictureError, RestorationError
from udccal.models.backscatter import Backscatter, cubic_weights, panel_light, panel_response
from udccal.numerics import in_float64
from udccal.restoration.prepared import kept
from udccal.rig import RigDescription

# Shares below this fraction of all light are left out.
_LEAST_SHARE = 1e-6
# A frame is darker than its panel's light where this is more than so many times the frame, and more than so few e-.
_MORE, _NEGLIGIBLE_E = 1.2, 1.0
# Samples of which the sums are taken: few, and by an odd step, so that every colour is among them.
SPARSE = np.s_[::5, ::5]


@final
@dataclass(frozen=True)
class PanelSums:
    """Backscatter as sums over panel pixels: for each place of the term's grid, a row of a sparse matrix.

    A camera close behind a panel sees some thousand of its pixels; the others are left out.

    Attributes:
        region: first row, end of rows, first column and end of columns of the panel's pixels that are seen.
        shares: fraction of each primary's light that the footprint collects.
        pixels: row-major index, in the region, of the pixel that it comes from.
        starts: first share of each place, and the number of shares.
        gain: e-/s of each camera colour per mixed light, by place.
        mix: matrix from primaries to camera colours.
        light: linear light of the 8-bit values of a picture.
        down, across: weights from the grid to the rows and columns of the mosaic.
    """

    region: Int32[np.ndarray, "4"]
    shares: Float32[np.ndarray, "3 shares"]
    pixels: Int32[np.ndarray, " shares"]
    starts: Int32[np.ndarray, " places_and_end"]
    gain: Float32[np.ndarray, "3 places"]
    mix: Float32[np.ndarray, "3 3"]
    light: Float32[np.ndarray, " 256"]
    down: Float32[np.ndarray, "rows grid_rows"]
    across: Float32[np.ndarray, "columns grid_columns"]

    def seen(
        self, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]
    ) -> UInt8[np.ndarray, "seen_rows seen_columns 3"]:
        """Return the part of a panel's picture that is seen, as a view."""
        top, bottom, left, right = self.region
        return picture[top:bottom, left:right]


@final
class _Latest:
    """The part that is seen of the latest picture of a panel, and its backscatter: one pair, since threads share it."""

    def __init__(self) -> None:
        self.found: tuple[UInt8[np.ndarray, "_ _ 3"], Float32[np.ndarray, "rows columns"]] | None = None


@final
@dataclass(frozen=True)
class PanelLight:
    """The backscatter of any picture on the rig's panel, quickly.

    Attributes:
        sums: the term, evaluated.
        cfa: the camera's colour pattern.
    """

    sums: PanelSums
    cfa: Cfa

    @classmethod
    def of(cls, term: Backscatter, rig: RigDescription, keep: Path | None = None) -> PanelLight:
        """Evaluate the term for the rig's panel.

        Args:
            term: the backscatter term.
            rig: the rig description.
            keep: folder that keeps the sums between starts; None to keep nothing.

        Raises:
            RestorationError: when a value is not finite.
        """
        size = rig.panel.rows, rig.panel.columns
        sums = kept(keep, PanelSums, (term, *size), lambda: _panel_sums(term, *size))
        return cls(sums, cfa_named(rig.camera.cfa))

    def of_rows(self, rows: slice) -> PanelLight:
        """Return the same for some rows of the mosaic, the first of which begins a cell of the colour pattern."""
        return replace(self, sums=replace(self.sums, down=self.sums.down[rows]))

    def rate(self, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]) -> Float32[np.ndarray, "rows columns"]:
        """Return the backscatter in e-/s at every sample of the mosaic while the panel shows ``picture``.

        The latest picture's is kept: a panel that stands still costs a comparison.
        """
        found, seen = self._latest.found, self.sums.seen(picture)
        if found is None or not np.array_equal(found[0], seen):
            self._latest.found = found = seen.copy(), self._summed(seen)
            found[1].setflags(write=False)
        return found[1]

    def _summed(
        self, seen: UInt8[np.ndarray, "seen_rows seen_columns 3"]
    ) -> Float32[np.ndarray, "sensor_rows sensor_columns"]:
        sums = self.sums
        light = np.ascontiguousarray(sums.light[seen].reshape(-1, 3).T)
        collected = np.stack([shares @ plane for shares, plane in zip(self._matrices, light, strict=True)])
        grid = (sums.gain * (sums.mix @ collected)).reshape(3, sums.down.shape[1], sums.across.shape[1])
        columns = np.ascontiguousarray(np.moveaxis(grid, 1, 2)).reshape(-1, grid.shape[1])
        rate = np.empty((len(sums.down), len(sums.across)), dtype=np.float32)
        for first, (down, across) in enumerate(self._interpolations):
            rate[first :: self.cfa.rows] = down @ np.ascontiguousarray((across @ columns).T)
        return rate

    @functools.cached_property
    def _latest(self) -> _Latest:
        return _Latest()

    @functools.cached_property
    def _matrices(self) -> list[sparse.csr_array]:
        top, bottom, left, right = self.sums.region
        shape = len(self.sums.starts) - 1, (bottom - top) * (right - left)
        return [sparse.csr_array((part, self.sums.pixels, self.sums.starts), shape) for part in self.sums.shares]

    @functools.cached_property
    def _interpolations(self) -> list[tuple[sparse.csr_array, sparse.csr_array]]:
        """Of every row of the pattern's cell: weights down, and weights across from the grids of all three colours.

        So whole rows of the mosaic come of one product; each site alone would be written sample by sample.
        """
        (columns, nodes), found = self.sums.across.shape, []
        for first, channels in enumerate(self.cfa.channels):
            across = np.zeros((columns, 3, nodes), dtype=np.float32)
            for column, channel in enumerate(channels):
                across[column :: self.cfa.columns, channel] = self.sums.across[column :: self.cfa.columns]
            down = sparse.csr_array(self.sums.down[first :: self.cfa.rows])
            found.append((down, sparse.csr_array(across.reshape(columns, -1))))
        return found


@in_float64
def _panel_sums(term: Backscatter, panel_rows: int, panel_columns: int) -> PanelSums:
    response = panel_response(term, panel_rows, panel_columns)
    shares, pixels, gain = (np.asarray(part) for part in (response.shares, response.pixels, response.gain))
    if not (np.all(np.isfinite(shares)) and np.all(np.isfinite(gain))):
        raise RestorationError(
            "Expected a footprint of the pupil on the panel for every pixel, found places without one. Check the "
            "backscatter and geometry terms, or calibrate the rig again."
        )
    # Shares are a fraction of about 1; what is left out of one is far below its own error.
    used = (shares > _LEAST_SHARE).any(axis=2)
    row, column = np.divmod(pixels[used], panel_columns)
    top, left = (int(part.min(initial=most - 1)) for part, most in ((row, panel_rows), (column, panel_columns)))
    bottom, right = (max(int(part.max(initial=0)), first) + 1 for part, first in ((row, top), (column, left)))
    mask = np.shape(term.mask)
    return PanelSums(
        np.array([top, bottom, left, right], dtype=np.int32),
        np.ascontiguousarray(shares[used].T, dtype=np.float32),
        ((row - top) * (right - left) + column - left).astype(np.int32),
        np.concatenate([[0], np.cumsum(used.sum(axis=1))]).astype(np.int32),
        gain.astype(np.float32),
        np.asarray(term.mix, dtype=np.float32),
        np.asarray(panel_light(term, np.arange(256)[:, None].repeat(3, axis=1)), dtype=np.float32)[:, 0],
        np.asarray(cubic_weights(term.rows, term.step, mask[1], np.dtype(float)), dtype=np.float32),
        np.asarray(cubic_weights(term.columns, term.step, mask[2], np.dtype(float)), dtype=np.float32),
    )


def refuse_excess(
    signal: Float32[np.ndarray, "rows columns"],
    panel_light: Float32[np.ndarray, "rows columns"],
    clipped: Bool[np.ndarray, "rows columns"],
) -> None:
    """Refuse a frame that is darker than the panel's light alone: light only adds.

    Args:
        signal: the frame in e-, divided by the wire.
        panel_light: backscatter in e- expected of the panel's picture at the frame's exposure.
        clipped: samples of the frame that say less than the light was; they are left out.

    Raises:
        PanelPictureError: when the panel's light is more than the frame's by a fifth, far beyond the mask's errors.
    """
    use = ~clipped[SPARSE]
    seen, expected = (float(np.sum(light[SPARSE], where=use, dtype=np.float64)) for light in (signal, panel_light))
    refuse_excess_of(seen, expected, float(np.count_nonzero(use)))


def refuse_excess_of(seen: float, expected: float, samples: float) -> None:
    """Refuse a frame as ``refuse_excess`` does, by the sums of its light and of the panel's over some samples."""
    if expected > _MORE * max(seen, 0.0) + samples * _NEGLIGIBLE_E:
        raise PanelPictureError(
            f"Expected a frame at least as bright as the panel's own light, found {seen / samples:.3g} e- per pixel "
            f"where the panel picture alone gives {expected / samples:.3g} e- at this exposure. Check that the "
            "exposure is in seconds (8 ms are 0.008), and that the panel showed that picture; or leave the picture out."
        )
