"""Chunk data: the parts of a payload after the picture (USB3 Vision, chunk data).

Each chunk is its data, then its id and the length of its data, both 32 bits and little-endian. So chunks are found from
the payload's end. The picture is the first of them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final, final

from udccal.errors import CameraProtocolError

_TAG: Final = struct.Struct("<II")
_MOST_CHUNKS: Final = 256


@final
@dataclass(frozen=True)
class Chunk:
    """Place of one chunk's data in a payload."""

    id: int
    start: int
    length: int


def parse_chunks(payload: memoryview) -> tuple[Chunk, ...]:
    """Return the chunks of a payload in their order.

    Raises:
        CameraProtocolError: when they do not fill it exactly, or there are more than any camera sends.
    """
    chunks: list[Chunk] = []
    end = len(payload)
    while end > 0:
        start = end - _TAG.size
        identifier, length = _TAG.unpack_from(payload, start) if start >= 0 else (0, 0)
        if start < 0 or length > start or len(chunks) >= _MOST_CHUNKS:
            raise CameraProtocolError(
                f"Expected chunks that fill {len(payload)} bytes of payload, found one of {length} bytes that ends at "
                f"{start}, after {len(chunks)} others. Check the cable; if that fails, update the camera's firmware."
            )
        end = start - length
        chunks.append(Chunk(identifier, end, length))
    return tuple(reversed(chunks))


def behind_picture(payload: memoryview, picture_bytes: int) -> bytes:
    """Return the part of a payload after the picture, itself a valid sequence of chunks.

    Args:
        payload: valid bytes of a frame with chunks.

    Raises:
        CameraProtocolError: when the chunks are invalid, or the first is too short for the picture.
    """
    chunks = parse_chunks(payload)
    length = chunks[0].length if chunks else 0
    if length < picture_bytes:
        raise CameraProtocolError(
            f"Expected a first chunk with {picture_bytes} bytes of picture, found {length}. Update the firmware."
        )
    return bytes(payload[length + _TAG.size :])
