"""What clips in pieces that are small enough to be lamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from udccal.restoration.tiles import TileLayout

# A piece has so many samples at least: smaller ones have little light, and edges of a picture are taken for it.
_LEAST: Final = 24
# How far its middle is from its rim: at least, for a thin line may be anything; and at most, or so much of the kernel's
# rows where that is more: a halo that reaches far tells of more.
_SMALLEST_PX, _LARGEST_PX, _LARGEST = 2.0, 8.0, 1 / 16
# Samples as near to a piece as this are hidden; its light lies this deep in it, or as deep as there is.
_RIM_PX, _INSIDE_PX = 3, 1.5
_RIM: Final = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _RIM_PX + 1, 2 * _RIM_PX + 1))
# Pixels that may have light: the time of a fit grows with their cube.
_MOST_PIXELS: Final = 700

Mask = Bool[np.ndarray, "rows columns"]


@final
@dataclass(frozen=True)
class Piece:
    """Samples that clip side by side.

    Attributes:
        tile: rows and columns of the strip: a tile with the piece in its middle, as far as the frame goes.
        index: of the layout's tile that is nearest.
        inside: pixels of the tile that may have the piece's light.
        own: its samples, and those beside them.
        area: its samples.
    """

    tile: tuple[slice, slice]
    index: int
    inside: Mask
    own: Mask
    area: int


def hidden_samples(clipped: Mask) -> Mask:
    """Return samples that clip, or are so near that a lamp's shape matters to them."""
    return cv2.dilate(_whole(clipped), _RIM) > 0


def lamp_pieces(clipped: Mask, layout: TileLayout, most: int, kernel_rows: int) -> list[Piece]:
    """Return at most so many pieces that may be lamps, the largest first; none of a frame smaller than a tile.

    Args:
        clipped: samples that say less than their light was, of the frame's rows ``layout.reach``.
        layout: the tiles.
        most: number of pieces.
        kernel_rows: of the kernels: how far a halo reaches.
    """
    size = layout.rows, layout.columns
    if most == 0 or np.count_nonzero(clipped) < _LEAST or min(np.subtract(clipped.shape, size)) < 0:
        return []
    whole = _whole(clipped)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(whole, connectivity=8)
    depth, largest = _depth(whole), max(_LARGEST_PX, _LARGEST * kernel_rows)
    found: list[Piece] = []
    for label in sorted(range(1, count), key=lambda one: -int(boxes[one, cv2.CC_STAT_AREA])):
        left, top, columns, rows, area = (int(value) for value in boxes[label])
        if area < _LEAST or len(found) == most:
            break
        box = np.s_[top : top + rows, left : left + columns]
        own = labels[box] == label
        deepest = float(depth[box][own].max())
        inside = own & (depth[box] > min(_INSIDE_PX, deepest - 0.5))
        large = 2 * rows > size[0] or 2 * columns > size[1]
        if _SMALLEST_PX <= deepest <= largest and not large and np.count_nonzero(inside) <= _MOST_PIXELS:
            found.append(_piece(box, own, inside, clipped.shape, layout))
    return found


def _piece(box: tuple[slice, slice], own: Mask, inside: Mask, shape: tuple[int, ...], layout: TileLayout) -> Piece:
    """Return a piece in a tile of its own, from its samples within a box of the strip."""
    size, cell = (layout.rows, layout.columns), (layout.cell_rows, layout.cell_columns)
    starts = [
        int(np.clip((part.start + part.stop - length) // 2, 0, most - length)) // step * step
        for part, length, most, step in zip(box, size, shape, cell, strict=True)
    ]
    within = tuple(slice(part.start - at, part.stop - at) for part, at in zip(box, starts, strict=True))
    masks = np.zeros((2, *size), dtype=bool)
    masks[:, *within] = own, inside
    y, x = ((part.start + part.stop) / 2 for part in box)
    index = int(((layout.centres_px - [x, y + layout.reach.start]) ** 2).sum(axis=1).argmin())
    tile = slice(starts[0], starts[0] + size[0]), slice(starts[1], starts[1] + size[1])
    beside = cv2.dilate(masks[0].astype(np.uint8), _RIM) > 0
    return Piece(tile, index, masks[1], beside, int(np.count_nonzero(own)))


def _whole(clipped: Mask) -> UInt8[np.ndarray, "rows columns"]:
    """Return what clips, with the gaps of a sample or two that colours which do not clip leave in it."""
    closed: np.ndarray = cv2.morphologyEx(clipped.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), dtype=np.uint8))
    return closed


def _depth(whole: UInt8[np.ndarray, "rows columns"]) -> Float64[np.ndarray, "rows columns"]:
    """Return how far each sample of a piece is from its rim; the frame's border is none: more may clip beyond."""
    wide = cv2.copyMakeBorder(whole, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    return cv2.distanceTransform(wide, cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1].astype(float)
