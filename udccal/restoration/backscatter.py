"""Backscatter to subtract: from the panel picture when it is known, from the mask alone when it is not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import jax
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from udccal.cfa import cfa_named
from udccal.errors import RestorationError
from udccal.models.backscatter import Backscatter, PanelResponse, panel_response, response_rate
from udccal.numerics import in_float64
from udccal.restoration.prepared import kept
from udccal.rig import RigDescription

# Side in samples of the blocks that give the level: large enough to average noise, small enough to find dark places.
_BLOCK = 16
_PERCENTILE = 1.0
# A frame is darker than its panel's light where this is more than so many times the frame, and more than so few e-.
_MORE, _NEGLIGIBLE_E = 1.2, 1.0
# Samples of which the sums are taken: few, and by an odd step, so that every colour is among them.
_SPARSE = np.s_[::5, ::5]


@final
@dataclass(frozen=True)
class _ResponseArrays:
    """The arrays of a ``PanelResponse`` beside its term."""

    shares: Float32[np.ndarray, "positions window2 3"]
    pixels: Int32[np.ndarray, "positions window2"]
    gain: Float32[np.ndarray, "3 positions"]


@in_float64
def prepared_response(term: Backscatter, rig: RigDescription, keep: Path | None = None) -> PanelResponse:
    """Evaluate the term for the rig's panel, as float32 numpy arrays.

    Args:
        term: the backscatter term.
        rig: the rig description.
        keep: folder that keeps the result between starts; None to keep nothing.

    Raises:
        RestorationError: when a value is not finite.
    """
    found = kept(keep, _ResponseArrays, (term, rig), lambda: _evaluated(term, rig))
    return PanelResponse(jax.tree.map(_single, term), found.shares, found.pixels, found.gain)


def _evaluated(term: Backscatter, rig: RigDescription) -> _ResponseArrays:
    response = panel_response(term, rig.panel.rows, rig.panel.columns)
    found = _ResponseArrays(_single(response.shares), np.asarray(response.pixels, np.int32), _single(response.gain))
    if not (np.all(np.isfinite(found.shares)) and np.all(np.isfinite(found.gain))):
        raise RestorationError(
            "Expected a footprint of the pupil on the panel for every pixel, found places without one. Check the "
            "backscatter and geometry terms, or calibrate the rig again."
        )
    return found


def _single(leaf: Any) -> np.ndarray:
    """Return a leaf as numpy, in single precision if it is real: jitted functions use it outside float64."""
    array = np.asarray(leaf)
    return array.astype(np.float32) if np.issubdtype(array.dtype, np.floating) else array


def known_rate(
    response: PanelResponse, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]
) -> Float32[np.ndarray, "rows columns"]:
    """Return the backscatter in e-/s at every sample of the mosaic while the panel shows ``picture``."""
    return np.asarray(response_rate(response, picture), dtype=np.float32)


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
        RestorationError: when the panel's light is more than the frame's by a fifth, far beyond the mask's errors.
    """
    use = ~clipped[_SPARSE]
    seen, expected = (float(np.sum(light[_SPARSE], where=use, dtype=np.float64)) for light in (signal, panel_light))
    samples = int(np.count_nonzero(use))
    if expected > _MORE * max(seen, 0.0) + samples * _NEGLIGIBLE_E:
        raise RestorationError(
            f"Expected a frame at least as bright as the panel's own light, found {seen / samples:.3g} e- per pixel "
            f"where the panel picture alone gives {expected / samples:.3g} e- at this exposure. Check that the "
            "exposure is in seconds (8 ms are 0.008), and that the panel showed that picture; or leave the picture out."
        )


def mask_mosaic(
    mask: Float32[np.ndarray, "half_rows half_columns 3"], cfa: str, rows: int, columns: int
) -> Float32[np.ndarray, "rows columns"]:
    """Return the profile's mask, one value per cell and channel, at every sample of the mosaic in its own colour."""
    last_row, last_column = mask.shape[0] - 1, mask.shape[1] - 1
    pattern = cfa_named(cfa)
    cell_rows = np.minimum(np.arange(rows) // pattern.rows, last_row)[:, None]
    cell_columns = np.minimum(np.arange(columns) // pattern.columns, last_column)[None, :]
    return mask[cell_rows, cell_columns, pattern.channel_map(rows, columns)]


def estimated_rate(
    signal_rate: Float32[np.ndarray, "rows columns"], mask: Float32[np.ndarray, "rows columns"], cfa: str
) -> Float32[np.ndarray, "rows columns"]:
    """Estimate the backscatter in e-/s when the panel picture is not known: the mask times one level per colour.

    Light only adds, so a frame is nowhere darker than its backscatter. The level, from 0 to 1, is the 1st percentile of
    frame over mask in blocks of 16 x 16 samples. In a scene without dark places the estimate is too high, by at most
    the scene's own darkest percent.
    """
    channels = cfa_named(cfa).channel_map(*signal_rate.shape)
    levels = np.array([_level(signal_rate, mask, channels == channel) for channel in range(3)], dtype=np.float32)
    return mask * levels[channels]


def _level(
    signal_rate: Float[np.ndarray, "rows columns"], mask: Float[np.ndarray, "rows columns"], own: np.ndarray
) -> float:
    light, possible = _block_sums(np.where(own, signal_rate, 0.0)), _block_sums(np.where(own, mask, 0.0))
    usable = possible > 0
    if not usable.any():
        return 0.0
    return float(np.clip(np.percentile(light[usable] / possible[usable], _PERCENTILE), 0.0, 1.0))


def _block_sums(samples: np.ndarray) -> Float[np.ndarray, "block_rows block_columns"]:
    rows, columns = (max(size // _BLOCK, 1) for size in samples.shape)
    cut = samples[: rows * _BLOCK, : columns * _BLOCK]
    return cut.reshape(rows, cut.shape[0] // rows, columns, cut.shape[1] // columns).sum(axis=(1, 3))
