"""Stamps of point sources as arrays, checked, and sorted by colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.cfa import channel_map
from udccal.errors import FitError

_FEWEST_PX, _MOST_PX = 7, 255
_MOST_SAMPLES = 2**26


@final
@dataclass(frozen=True)
class Stamps:
    """What a fit is given: each stamp is cut about one point source; what else shines has been subtracted.

    Attributes:
        values_e: samples in electrons; NaN where nothing is known.
        position_px: of each stamp's middle sample (``rows // 2, columns // 2``) on the sensor, (x, y).
        read_e: standard deviation of a sample's noise without light, in electrons, quantisation included.
        clip_e: samples at or above it tell only that they are so.
        channel: of each sample (0 = R, 1 = G, 2 = B) of raw mosaics; ``None`` where all samples are of one kind.
    """

    values_e: Float[np.ndarray, "stars rows columns"]
    position_px: Int[np.ndarray, "positions 2"]
    read_e: float
    clip_e: float = np.inf
    channel: Int[np.ndarray, "*channels"] | None = None

    def __post_init__(self) -> None:
        _check(self)

    @property
    def planes(self) -> int:
        """How many colours there are."""
        return 1 if self.channel is None else int(self.channel.max()) + 1


def mosaic_channels(
    cfa: str, position_px: Int[np.ndarray, "stars 2"], rows: int, columns: int
) -> Int[np.ndarray, "stars rows columns"]:
    """Channels of stamps cut from a mosaic whose first 2 x 2 cell is ``cfa``; for ``Stamps.channel``.

    Raises:
        ValueError: when ``cfa`` is not four letters of R, G, B.
    """
    cell = channel_map(cfa, 2, 2)
    y = position_px[:, 1, None] - rows // 2 + np.arange(rows)
    x = position_px[:, 0, None] - columns // 2 + np.arange(columns)
    return cell[y[:, :, None] % 2, x[:, None, :] % 2]


@dataclass(frozen=True)
class Plane:
    """The samples of one colour; stamps that hold fewer than others are padded with samples that are not used.

    Attributes:
        offset_px: (x, y) from each stamp's middle sample.
        value_e: zero where not used.
        usable: whether a sample tells something.
        clipped: whether it tells only that it is at or above the clipping.
        place: flat index of the sample in its stamp.
    """

    offset_px: Float[np.ndarray, "stars samples 2"]
    value_e: Float[np.ndarray, "stars samples"]
    usable: Bool[np.ndarray, "stars samples"]
    clipped: Bool[np.ndarray, "stars samples"]
    place: Int[np.ndarray, "stars samples"]


def split(stamps: Stamps) -> tuple[Plane, ...]:
    """The stamps colour by colour."""
    count, rows, columns = stamps.values_e.shape
    channel = np.zeros((count, rows * columns), dtype=np.int64)
    if stamps.channel is not None:
        channel = stamps.channel.reshape(count, -1).astype(np.int64)
    return tuple(_plane(stamps, channel == colour) for colour in range(stamps.planes))


def _plane(stamps: Stamps, own: Bool[np.ndarray, "stars pixels"]) -> Plane:
    count, rows, columns = stamps.values_e.shape
    most = int(own.sum(axis=1).max())
    # Stable: a stamp's own samples first, in their order.
    place = np.argsort(~own, axis=1, kind="stable")[:, :most]
    value = np.take_along_axis(stamps.values_e.reshape(count, -1), place, axis=1)
    usable = np.take_along_axis(own, place, axis=1) & np.isfinite(value)
    y, x = np.divmod(place, columns)
    return Plane(
        offset_px=np.stack([x - columns // 2, y - rows // 2], axis=-1).astype(np.float64),
        value_e=np.where(usable, value, 0.0),
        usable=usable,
        clipped=usable & (value >= stamps.clip_e),
        place=place,
    )


def _check(stamps: Stamps) -> None:
    count, rows, columns = stamps.values_e.shape
    if min(rows, columns) < _FEWEST_PX or max(rows, columns) > _MOST_PX:
        raise FitError(
            f"Expected stamps of {_FEWEST_PX} to {_MOST_PX} samples a side, found {rows} x {columns}. Cut them anew."
        )
    if stamps.values_e.size > _MOST_SAMPLES:
        raise FitError(f"Expected at most {_MOST_SAMPLES} samples, found {stamps.values_e.size}. Use fewer stamps.")
    if stamps.position_px.shape[0] != count:
        raise FitError(f"Expected a position for each of {count} stamps, found {stamps.position_px.shape[0]}.")
    if not (np.isfinite(stamps.read_e) and stamps.read_e > 0):
        raise FitError(f"Expected a read noise above 0 e-, found {stamps.read_e}. Count the quantisation into it.")
    if not stamps.clip_e > 0:
        raise FitError(f"Expected a clipping level above 0 e-, found {stamps.clip_e}. Leave it out if nothing clips.")
    if stamps.channel is not None:
        _check_channel(stamps.channel, stamps.values_e.shape)


def _check_channel(channel: Int[np.ndarray, "..."], shape: tuple[int, ...]) -> None:
    if channel.shape != shape:
        raise FitError(f"Expected a channel for every sample, {shape}, found {channel.shape}.")
    found = np.unique(channel)
    if not np.array_equal(found, np.arange(len(found))) or len(found) > 3:
        raise FitError(f"Expected channels 0, 1 and 2 without gaps, found {found.tolist()}. Number them from 0.")
