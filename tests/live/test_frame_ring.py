"""The layout that docs/live.md describes, and frames that a reader must know to be torn."""

from __future__ import annotations

import fcntl
import mmap
import struct
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from examples.read_live import frames
from tests.live.conftest import restored_frame
from udccal.live.sinks.frame_ring import FrameRing, Layout

LAYOUT = Layout(5, 7)
DOCS = Path(__file__).resolve().parents[2] / "docs" / "live.md"


def test_bytes_are_where_the_documentation_says() -> None:
    memory = bytearray(LAYOUT.total_bytes)
    ring = FrameRing(memory, LAYOUT)
    for number in range(6):
        ring.publish(restored_frame(number, 5, 7))
    assert memory[:8] == b"UDCCALFR"
    assert struct.unpack_from("<8I", memory, 8) == (1, 128, 7, 5, 21, 1, 4, 64)
    assert struct.unpack_from("<4Q", memory, 40) == (256, 128, 6, 0)
    slot = 128 + 1 * 256  # frame 5 is the sixth: the second slot
    assert struct.unpack_from("<3Q", memory, slot) == (6, 5, round(5e9 / 30))
    (published_ns,) = struct.unpack_from("<Q", memory, slot + 24)
    assert 0 <= time.monotonic_ns() - published_ns < 60e9
    assert memory[slot + 64 : slot + 64 + 105] == bytes([5]) * 105
    assert struct.unpack_from("<Q", memory, slot + 256 - 64) == (6,)
    assert len(memory) == 128 + 4 * 256
    ring.close()
    assert struct.unpack_from("<Q", memory, 64) == (1,)


def test_the_documentation_lists_the_header() -> None:
    text = DOCS.read_text(encoding="utf-8")
    for place, name in ((0, "magic"), (40, "slot bytes"), (56, "newest"), (64, "closed")):
        assert f"| {place} | " in text
        assert name in text


def _as_its_writer(path: Path) -> mmap.mmap:
    """A file's memory, which keeps the file locked for as long as it is there."""
    with path.open("r+b") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return mmap.mmap(file.fileno(), 0)


@pytest.fixture
def shared(tmp_path: Path) -> tuple[mmap.mmap, FrameRing, str]:
    """Memory in a file, its writer, and the name under which the example finds it."""
    path = tmp_path / "segment"
    path.write_bytes(bytes(LAYOUT.total_bytes))
    memory = _as_its_writer(path)
    return memory, FrameRing(memory, LAYOUT), str(path)


def test_a_torn_slot_is_known(shared: tuple[mmap.mmap, FrameRing, str]) -> None:
    memory, ring, name = shared
    reader = frames(name)
    ring.publish(restored_frame(0, 5, 7))
    frame_id, picture = next(reader)
    assert frame_id == 0
    assert picture is not None
    ring.publish(restored_frame(1, 5, 7))
    struct.pack_into("<Q", memory, 128 + 256, 6)  # as if the writer had begun another frame in this slot
    assert next(reader) == (1, None)
    ring.publish(restored_frame(2, 5, 7))
    struct.pack_into("<Q", memory, 128 + 3 * 256 - 64, 1)  # as if it had not yet ended this one
    assert next(reader) == (2, None)
    ring.close()
    assert list(reader) == []


def test_frames_read_while_they_are_written_are_whole_or_known_to_be_torn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one slot instead of four, a writer that never rests often overtakes the reader."""
    monkeypatch.setattr("udccal.live.sinks.frame_ring.SLOTS", 1)
    layout, path = Layout(300, 400), tmp_path / "segment"
    path.write_bytes(bytes(layout.total_bytes))
    ring = FrameRing(_as_its_writer(path), layout)
    pictures = [restored_frame(number, 300, 400) for number in range(251)]
    ended = threading.Event()

    def write() -> None:
        while not ended.is_set():
            for picture in pictures:
                ring.publish(picture)
                if ended.wait(1e-4):
                    break
        ring.close()

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    whole = torn = 0
    deadline = time.monotonic() + 60
    for frame_id, picture in frames(str(path)):
        torn += picture is None
        whole += picture is not None
        assert picture is None or np.all(picture == frame_id)
        if (whole > 5 and torn > 5) or time.monotonic() > deadline:
            ended.set()
    writer.join(10)
    assert whole > 5
    assert torn > 5
