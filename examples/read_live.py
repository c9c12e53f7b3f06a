"""`read_live.py NAME` counts the frames of `udccal run --sink shm:NAME`; docs/live.md has the layout of the memory."""

import contextlib
import fcntl
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np


def frames(name: str) -> Iterator[tuple[int, np.ndarray | None]]:
    """Frame id and RGB picture of each newest frame, until the writer ends; None for a torn one."""
    with Path("/dev/shm", name).open("rb") as file:
        words, seen = (memory := np.memmap(file, np.uint8, "r")).view(np.uint64), 0
        version, _, width, height, stride, kind, slots, edge = memory[8:40].view(np.uint32).tolist()
        if (bytes(memory[:8]), version, kind) != (b"UDCCALFR", 1, 1):
            sys.exit(f"expected frames of udccal, version 1, 8-bit RGB, in {name}, found something else")
        while not words[8]:  # the writer has not ended
            if (newest := int(words[7])) == seen:
                time.sleep(1e-3)
                with contextlib.suppress(BlockingIOError):  # the writer locks the memory for as long as it lives
                    fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                    if not words[8]:
                        sys.exit(f"expected the writer of {name} to live, found that it was killed; start it again")
                continue
            slot, seen = int(words[6]) + (newest - 1) % slots * int(words[5]), newest
            last = words[(slot + int(words[5]) - edge) // 8]  # first of all
            rows = memory[slot + edge :][: stride * height].reshape(height, stride)[:, : 3 * width].copy()
            yield int(words[slot // 8 + 1]), rows.reshape(height, -1, 3) if last == newest == words[slot // 8] else None


if __name__ == "__main__":
    for frame_id, picture in frames(sys.argv[1]):
        print(f"frame {frame_id}: {'torn' if picture is None else f'mean {picture.mean():.2f}'}", flush=True)
