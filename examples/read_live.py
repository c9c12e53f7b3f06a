"""Counts the frames of `udccal run --sink shm:NAME` in another program; docs/live.md has the layout of the memory."""

import argparse
import contextlib
import fcntl
import mmap
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np


def frames(name: str) -> Iterator[tuple[int, np.ndarray | None]]:
    """Frame number and RGB picture of each newest frame, until the writer ends; None for a torn one."""
    with Path("/dev/shm", name).open("rb") as file:
        yield from _frames(file, name)


def _frames(file: BinaryIO, name: str) -> Iterator[tuple[int, np.ndarray | None]]:
    memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    header = struct.unpack_from("<8s8I2Q", memory)
    magic, version, _, width, height, stride, pixel_format, slots, edge, slot_bytes, first_slot = header
    if (magic, version, pixel_format) != (b"UDCCALFR", 1, 1):
        raise SystemExit(f"expected frames of udccal, version 1, 8-bit RGB, in {name}, found something else")
    words, seen, waited = np.frombuffer(memory, np.uint64), 0, 0
    while not words[64 // 8]:  # the writer has not ended
        newest = int(words[56 // 8])
        if newest == seen:
            time.sleep(1e-3)
            waited += 1
            if waited % 250 == 0 and not (_is_written(file) or words[64 // 8]):
                raise SystemExit(f"expected the writer of {name} to live, found that it was killed; start it again")
            continue
        seen, waited, slot = newest, 0, first_slot + (newest - 1) % slots * slot_bytes
        last = int(words[(slot + slot_bytes - edge) // 8])  # first of all
        pixels = np.frombuffer(memory, np.uint8, stride * height, slot + edge).reshape(height, stride)
        picture, frame_id = pixels[:, : 3 * width].reshape(height, width, 3).copy(), int(words[slot // 8 + 1])
        whole = last == newest == int(words[slot // 8])  # last of all
        yield frame_id, picture if whole else None


def _is_written(file: BinaryIO) -> bool:
    """Whether the writer lives: it locks the memory for as long as it does."""
    with contextlib.suppress(BlockingIOError):
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        fcntl.flock(file, fcntl.LOCK_UN)
        return False
    return True


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    for frame_id, picture in frames(parser.parse_args().name):
        print(f"frame {frame_id}: {'torn' if picture is None else f'mean {picture.mean():.2f}'}", flush=True)
