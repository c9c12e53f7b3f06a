"""Check that a PNG file is whole before it is decoded.

Decoders allocate as much memory as a chunk's length says, up to four gigabytes, and fill missing data with zeros.

Source: Portable Network Graphics (PNG) Specification, third edition, clause 5.
"""

from __future__ import annotations

import struct
import zlib

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHUNK = struct.Struct(">I4s")
_CRC = struct.Struct(">I")


def png_fault(content: bytes) -> str | None:
    """Return what is wrong with the chunks of a PNG file, in words that follow "found"; None when it is whole."""
    if not content.startswith(SIGNATURE):
        return "other content"
    place = len(SIGNATURE)
    while place + _CHUNK.size <= len(content):
        length, kind = _CHUNK.unpack_from(content, place)
        end = place + _CHUNK.size + length + _CRC.size
        if end > len(content):
            return "it cut short"
        (crc,) = _CRC.unpack_from(content, end - _CRC.size)
        if zlib.crc32(content[place + 4 : end - _CRC.size]) != crc:
            return "damaged data"
        if kind == b"IEND":
            return None if end == len(content) else "more data after its end"
        place = end
    return "it cut short"
