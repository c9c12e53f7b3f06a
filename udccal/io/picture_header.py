"""Number of pixels in the header of a JPEG, PNG or Radiance picture, read before a decoder allocates memory."""

from __future__ import annotations

import re
import struct

from udccal.io.png_chunks import SIGNATURE

_JPEG = b"\xff\xd8\xff"
_JPEG_FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})  # SOF markers, ITU-T T.81 table B.1
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length
_RADIANCE = (b"#?RADIANCE", b"#?RGBE")
_RADIANCE_SIZE = re.compile(rb"\n\n[-+][XY] (\d{1,6}) [-+][XY] (\d{1,6})\n")
_RADIANCE_HEADER = 8192


def picture_size(content: bytes) -> tuple[int, int] | None:
    """Return (rows, columns) from the header of a PNG, JPEG or Radiance picture; None for others and broken headers.

    The two are exchanged where the picture is stored on its side.
    """
    if content.startswith(SIGNATURE):
        return _png_size(content)
    if content.startswith(_JPEG):
        return _jpeg_size(content)
    if content.startswith(_RADIANCE):
        found = _RADIANCE_SIZE.search(content[:_RADIANCE_HEADER])
        return None if found is None else (int(found[1]), int(found[2]))
    return None


def _png_size(content: bytes) -> tuple[int, int] | None:
    if len(content) < 24 or content[12:16] != b"IHDR":
        return None
    columns, rows = struct.unpack_from(">II", content, 16)
    return rows, columns


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    place = 2
    while place + 4 <= len(content):
        if content[place] != 0xFF:
            return None
        marker = content[place + 1]
        if marker == 0xFF or marker in _JPEG_BARE:
            place += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack_from(">H", content, place + 2)
        if marker in _JPEG_FRAMES:
            if place + 9 > len(content):
                return None
            rows, columns = struct.unpack_from(">HH", content, place + 5)
            return rows, columns
        place += 2 + max(length, 2)
    return None
