"""A raw frame as a picture for a page: half-size colours, a zebra on clipped samples, a histogram."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Bool, Int, UInt8, UInt16

from udccal.cameras.protocol import Frame
from udccal.cfa import BLUE, GREEN, RED, Cfa, cfa_named
from udccal.rig import RigDescription

MOST_PX: Final = 960
BINS: Final = 64
_GAMMA = 2.2
_JPEG_QUALITY = 80
_STRIPE_PX = 8
# Blue, green, red. Both are red, so that a lone clipped sample shows whichever it meets.
_STRIPES: Final = ((50, 50, 255), (0, 0, 140))


@final
@dataclass(frozen=True)
class Sampling:
    """What a camera's numbers mean.

    Attributes:
        cfa: pattern of the whole sensor's top left.
        black_DN: level without light.
        clipped_DN: level from which a sample counts as clipped.
    """

    cfa: Cfa
    black_DN: float
    clipped_DN: float

    @staticmethod
    def of(rig: RigDescription) -> Sampling:
        """That of a rig's camera, with the level from which the checks of frames count a sample as clipped."""
        return Sampling(cfa_named(rig.camera.cfa), rig.camera.black_DN.value, rig.lowest_saturation_DN)


@final
@dataclass(frozen=True)
class Picture:
    """A frame for a page.

    Attributes:
        jpeg: at most ``MOST_PX`` on its longer side.
        histogram: pixels of red, green and blue in bins of equal width of the displayed value.
        clipped: share of the frame's samples that are clipped.
    """

    jpeg: bytes
    histogram: Int[np.ndarray, "3 bins"]
    clipped: float


def make_picture(frame: Frame, sampling: Sampling) -> Picture:
    """Return a frame as a picture: black to clipped, display-encoded, without white balance."""
    clipped = frame.data >= np.uint16(np.clip(np.ceil(sampling.clipped_DN), 0, 2**16 - 1))
    shown = _tones(sampling)[_reduced(half_size(frame.data, sampling.cfa))]
    # OpenCV has blue first.
    counts = [cv2.calcHist([shown], [channel], None, [BINS], [0.0, 256.0]).ravel() for channel in (2, 1, 0)]
    paint_zebra(shown, clipped)
    _, jpeg = cv2.imencode(".jpg", shown, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))
    return Picture(jpeg.tobytes(), np.array(counts, dtype=np.int64), float(np.count_nonzero(clipped) / clipped.size))


def half_size(mosaic: UInt16[np.ndarray, "rows columns"], cfa: Cfa) -> UInt16[np.ndarray, "half_rows half_columns 3"]:
    """Return one pixel (blue, green, red) for each whole cell of a mosaic: the first sample of each colour in it."""
    rows, columns = mosaic.shape[0] // cfa.rows, mosaic.shape[1] // cfa.columns
    whole = mosaic[: rows * cfa.rows, : columns * cfa.columns]
    first = {site.channel: site for site in reversed(cfa.sites)}
    return cv2.merge([whole[first.get(channel, cfa.sites[0]).samples] for channel in (BLUE, GREEN, RED)])


def paint_zebra(
    picture: UInt8[np.ndarray, "rows columns 3"], clipped: Bool[np.ndarray, "frame_rows frame_columns"]
) -> None:
    """Paint slanted stripes, in place, on every pixel that holds a clipped sample, and on its neighbours."""
    if not clipped.any():
        return
    # Two means, of which the first is of whole cells and quick. A lone sample is more than nothing after both.
    cells = clipped.shape[1] // 2, clipped.shape[0] // 2
    some = cv2.resize(clipped.view(np.uint8) * np.uint8(255), cells, interpolation=cv2.INTER_AREA)
    some = cv2.resize(some, picture.shape[1::-1], interpolation=cv2.INTER_AREA)
    some = cv2.dilate(some, np.ones((3, 3), np.uint8))  # a single pixel would not be seen
    cv2.copyTo(_zebra(*some.shape), some, picture)


@functools.lru_cache(maxsize=2)
def _zebra(rows: int, columns: int) -> UInt8[np.ndarray, "rows columns 3"]:
    which = (np.arange(rows)[:, None] + np.arange(columns)) // _STRIPE_PX % 2
    return np.array(_STRIPES, dtype=np.uint8)[which]


def _reduced(colours: UInt16[np.ndarray, "rows columns 3"]) -> UInt16[np.ndarray, "small_rows small_columns 3"]:
    """Return at most ``MOST_PX`` on the longer side: means of whole blocks, then interpolated, which is quick."""
    block = max(max(colours.shape[:2]) // MOST_PX, 1)
    rows, columns = (count // block for count in colours.shape[:2])
    if block > 1:
        whole = colours[: rows * block, : columns * block]
        colours = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    scale = min(MOST_PX / max(rows, columns), 1.0)
    return cv2.resize(colours, (max(round(columns * scale), 1), max(round(rows * scale), 1)))


def _tones(sampling: Sampling) -> UInt8[np.ndarray, " levels"]:
    """Return the displayed value of every number that 16 bits hold."""
    reach = max(sampling.clipped_DN - sampling.black_DN, 1.0)
    light = np.clip((np.arange(2**16) - sampling.black_DN) / reach, 0.0, 1.0)
    return np.rint(255.0 * light ** (1.0 / _GAMMA)).astype(np.uint8)
