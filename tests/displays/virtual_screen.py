"""An X server without a monitor, whose pixels are read from its own memory file, by no help of SDL."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import UInt8

# X11/XWDFile.h: 25 unsigned numbers of 32 bits, most significant byte first; a name; the colour map; the pixels.
_HEADER = struct.Struct(">25I")
_COLOUR_BYTES = 12
_Z_PIXMAP, _LEAST_FIRST = 2, 0
_END_S = 5


@dataclass(frozen=True)
class VirtualScreen:
    """A running X server; ``display`` is its name, e.g. ``:3``."""

    display: str
    folder: Path
    process: subprocess.Popen

    def pixels(self, screen: int = 0) -> UInt8[np.ndarray, "rows columns 3"]:
        """What is on a screen now."""
        return read_xwd((self.folder / f"Xvfb_screen{screen}").read_bytes())


@contextmanager
def virtual_screen(*screens: str) -> Iterator[VirtualScreen]:
    """Start a server with screens such as ``1920x1080x24``; skips the test where Xvfb is not installed."""
    if shutil.which("Xvfb") is None:
        pytest.skip("needs Xvfb (Debian package xvfb), which this machine lacks")
    listed = [word for index, size in enumerate(screens) for word in ("-screen", str(index), size)]
    said, told = os.pipe()
    with tempfile.TemporaryDirectory() as folder, os.fdopen(said) as names:
        # A server that resets when its last client leaves refuses, for a moment, the one that comes next.
        process = subprocess.Popen(
            ["Xvfb", "-noreset", "-displayfd", str(told), *listed, "-fbdir", folder, "-nolisten", "tcp"],
            pass_fds=[told],
            stderr=subprocess.DEVNULL,
        )
        os.close(told)
        try:
            number = names.readline().strip()  # said once it listens; empty when it ended instead
            assert number, "Xvfb ended before it was ready"
            yield VirtualScreen(f":{number}", Path(folder), process)
        finally:
            process.terminate()
            process.wait(_END_S)


def read_xwd(content: bytes) -> UInt8[np.ndarray, "rows columns 3"]:
    """RGB of an X window dump of 32 bits per pixel."""
    header = _HEADER.unpack_from(content)
    header_bytes, _, kind, _, columns, rows, _, order = header[:8]
    bits, row_bytes, masks, colours = header[11], header[12], header[14:17], header[19]
    assert (kind, order, bits) == (_Z_PIXMAP, _LEAST_FIRST, 32)
    start = header_bytes + colours * _COLOUR_BYTES
    lines = np.frombuffer(content, "<u4", rows * row_bytes // 4, start).reshape(rows, row_bytes // 4)
    shifts = [(mask & -mask).bit_length() - 1 for mask in masks]
    return np.stack(
        [(lines[:, :columns] & mask) >> shift for mask, shift in zip(masks, shifts, strict=True)], -1
    ).astype(np.uint8)
