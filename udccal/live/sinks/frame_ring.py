"""Layout of the shared memory in which readers find frames; docs/live.md describes it byte by byte.

A slot has the frame's number before and after its pixels. The writer writes the first one before anything else and the
last one after everything else; a reader reads the last one first. Where a reader finds the same number in both, the
pixels that it copied in between belong to that frame. Nobody waits for anybody.
"""

from __future__ import annotations

import struct
import time
from dataclasses import dataclass
from mmap import mmap
from typing import Final, final

import numpy as np

from udccal.live.sinks.protocol import RestoredFrame

MAGIC: Final = b"UDCCALFR"
VERSION: Final = 1
RGB8: Final = 1
SLOTS: Final = 4

HEADER_BYTES: Final = 128
_HEADER: Final = struct.Struct("<8s8I2Q")
_NEWEST, _CLOSED = 56 // 8, 64 // 8
# A slot begins and ends with this many bytes, a line of the processor's cache.
_EDGE_BYTES: Final = 64


@final
@dataclass(frozen=True)
class Layout:
    """Places in the memory for pictures of ``rows`` x ``columns`` pixels of 8-bit RGB."""

    rows: int
    columns: int

    @property
    def stride(self) -> int:
        """Bytes from a row to the next."""
        return 3 * self.columns

    @property
    def slot_bytes(self) -> int:
        """Bytes from a slot to the next, a multiple of 64."""
        return 2 * _EDGE_BYTES + -(-self.stride * self.rows // _EDGE_BYTES) * _EDGE_BYTES

    @property
    def total_bytes(self) -> int:
        """Size of the whole."""
        return HEADER_BYTES + SLOTS * self.slot_bytes

    def header(self) -> bytes:
        """Return the constant part of the header."""
        sizes = (self.columns, self.rows, self.stride)
        return _HEADER.pack(
            MAGIC, VERSION, HEADER_BYTES, *sizes, RGB8, SLOTS, _EDGE_BYTES, self.slot_bytes, HEADER_BYTES
        )


@final
class FrameRing:
    """Writes frames into memory of that layout, one slot after the other."""

    def __init__(self, memory: mmap | bytearray, layout: Layout) -> None:
        memory[: _HEADER.size] = layout.header()
        self._layout = layout
        self._words = np.frombuffer(memory, np.uint64)  # whole words are stored at once
        self._bytes = np.frombuffer(memory, np.uint8)
        self._number = 0

    def publish(self, frame: RestoredFrame) -> None:
        """Write a frame into the oldest slot, then name it as the newest."""
        layout, words = self._layout, self._words
        start = HEADER_BYTES + self._number % SLOTS * layout.slot_bytes
        first, pixels, last = start // 8, start + _EDGE_BYTES, (start + layout.slot_bytes - _EDGE_BYTES) // 8
        self._number += 1
        words[first] = self._number
        self._bytes[pixels : pixels + layout.stride * layout.rows] = frame.picture.reshape(-1)
        words[first + 1 : first + 4] = (frame.frame_id, frame.captured_ns, time.monotonic_ns())
        words[last] = self._number
        words[_NEWEST] = self._number

    def close(self) -> None:
        """Tell readers that no more frames will come."""
        self._words[_CLOSED] = 1
