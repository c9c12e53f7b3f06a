"""Face-like pictures for the panel: crowds of heads of all sizes, in front of a busy wall.

A camera behind the panel sees about 30 x 30 panel pixels, out of focus. To identify that footprint, pictures must
differ in brightness, colour and shapes of that size. Heads from a few pixels to a fifth of the panel are scattered all
over, so that edges, eyes and hair cross any such place.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8

_SKINS = ((247, 214, 190), (234, 187, 154), (198, 143, 108), (141, 96, 70), (92, 61, 46))
_HEADS_PER_MEGAPIXEL = 430
_SMALLEST_HEAD_PX = 14.0
_SUBPIXEL_BITS = 4
# A procedure's steps are listed several times in a session, each time with their pictures.
_KEPT_PICTURES = 8

Picture = UInt8[np.ndarray, "rows columns 3"]


@dataclass(frozen=True)
class _Head:
    """Centre and height of a head in px, and its lean."""

    x: float
    y: float
    size: float
    lean_deg: float


@lru_cache(maxsize=_KEPT_PICTURES)
def face_picture(seed: int, columns: int, rows: int) -> Picture:
    """Draw a crowd in 8-bit RGB; the array is shared, and cannot be written to.

    Args:
        seed: each seed gives another crowd, in other colours and another light.
        columns: columns of the panel. rows: rows of the panel.
    """
    rng = np.random.default_rng([seed, 0xC20D])
    picture = _wall(rng, columns, rows)
    largest = max(0.2 * rows, 2 * _SMALLEST_HEAD_PX)
    heads = max(1, round(_HEADS_PER_MEGAPIXEL * rows * columns / 1e6))
    sizes = np.exp(rng.uniform(np.log(_SMALLEST_HEAD_PX), np.log(largest), heads))
    for size in np.sort(sizes)[::-1]:
        x, y, lean_deg = (float(v) for v in rng.uniform([0, 0, -20], [columns, rows, 20]))
        _draw_person(picture, rng, _Head(x, y, float(size), lean_deg))
    light = rng.uniform(0.75, 1.0) * rng.uniform(0.75, 1.0, 3)
    shown = np.rint(picture * light).astype(np.uint8)
    shown.flags.writeable = False
    return shown


def _wall(rng: np.random.Generator, columns: int, rows: int) -> Picture:
    """Draw blocks of colour, like shelves and windows, with a gradient of light."""
    blocks = rng.integers(20, 256, (max(2, rows // 40), max(2, columns // 30), 3), dtype=np.uint8)
    wall = cv2.resize(blocks, (columns, rows), interpolation=cv2.INTER_NEAREST)
    fall = np.linspace(1.0, rng.uniform(0.4, 1.0), columns)[None, :, None]
    return np.ascontiguousarray(wall * fall).astype(np.uint8)


def _draw_person(picture: Picture, rng: np.random.Generator, head: _Head) -> None:
    """Draw head and shoulders."""
    light = rng.uniform(0.6, 1.5)
    skin = light * np.array(_SKINS[rng.integers(len(_SKINS))], dtype=float)
    hair, coat = light * rng.uniform(5, 150, 3) * rng.uniform(0.2, 1.0), light * rng.uniform(0, 255, 3)
    _ellipse(picture, head, (0.0, 0.95), (0.75, 0.5), coat)
    _ellipse(picture, head, (0.0, -0.08), (0.43, 0.55), hair)
    _ellipse(picture, head, (0.0, 0.5), (0.16, 0.2), 0.8 * skin)
    _ellipse(picture, head, (0.0, 0.06), (0.34, 0.46), skin)
    for side in (-1, 1):
        _ellipse(picture, head, (0.14 * side, -0.02), (0.075, 0.04), np.full(3, 240.0 * light))
        _ellipse(picture, head, (0.14 * side, -0.02), (0.035, 0.038), hair * 0.4)
        _ellipse(picture, head, (0.14 * side, -0.1), (0.09, 0.02), hair)
    _ellipse(picture, head, (0.0, 0.13), (0.035, 0.08), 0.85 * skin)
    _ellipse(picture, head, (0.0, 0.28), (0.12, 0.04), light * np.array([170.0, 50.0, 60.0]))


def _ellipse(
    picture: Picture,
    head: _Head,
    middle: tuple[float, float],
    half_axes: tuple[float, float],
    colour: Float[np.ndarray, "3"],
) -> None:
    """Draw one ellipse, measured in heads from the centre of the head."""
    fine = 2**_SUBPIXEL_BITS
    centre = (round((head.x + middle[0] * head.size) * fine), round((head.y + middle[1] * head.size) * fine))
    axes = (max(1, round(half_axes[0] * head.size * fine)), max(1, round(half_axes[1] * head.size * fine)))
    rgb = tuple(float(round(min(max(value, 0.0), 255.0))) for value in colour.tolist())
    cv2.ellipse(picture, centre, axes, head.lean_deg, 0, 360, rgb, cv2.FILLED, cv2.LINE_AA, _SUBPIXEL_BITS)
