from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from udccal.cameras.u3v.readahead import ReadAhead
from udccal.cameras.u3v.receiver import Block
from udccal.cameras.u3v.stream import Leader, PayloadType
from udccal.errors import CameraTimeout


class Source:
    """Blocks 0, 1, 2 ... at once, each filled with its number, until ``fails_at``."""

    room = 16

    def __init__(self, fails_at: int | None = None, silent_from: int | None = None) -> None:
        self.made, self.fails_at, self.silent_from = 0, fails_at, silent_from
        self.stopped = threading.Event()

    def receive(self, payload: memoryview, wait_s: float, stopped: Callable[[], bool]) -> Block | None:
        if self.made == self.fails_at:
            time.sleep(0.01)
            raise CameraTimeout("Expected a frame, found none. Wait.")
        if self.made == self.silent_from:
            while not stopped():
                time.sleep(1e-3)
            self.stopped.set()
            return None
        payload[:] = bytes([self.made % 256]) * len(payload)
        self.made += 1
        return Block(Leader(self.made - 1, PayloadType.IMAGE, 0, None), None, len(payload))


def settled(source: Source) -> int:
    """How many blocks were made, once no more are."""
    made = -1
    while made != source.made:
        made = source.made
        time.sleep(0.1)
    return made


def test_blocks_keep_their_payload_while_the_reader_goes_on() -> None:
    source = Source()
    ids = []
    for payload, block in ReadAhead(source, 100, 1.0).blocks():
        ids.append(block.leader.block_id)
        time.sleep(1e-3)
        assert payload.tobytes() == bytes([block.leader.block_id]) * 16
    assert ids == list(range(100))


def test_reads_ahead_but_only_as_far_as_there_are_buffers() -> None:
    source = Source()
    blocks = ReadAhead(source, 1000, 1.0).blocks()
    next(blocks)
    assert 2 < settled(source) <= 32
    blocks.close()


def test_no_more_is_read_than_asked_for() -> None:
    source = Source()
    assert len(list(ReadAhead(source, 3, 1.0).blocks())) == 3
    assert source.made == 3


def test_an_error_comes_after_what_was_read_before() -> None:
    blocks = ReadAhead(Source(fails_at=4), 10, 1.0).blocks()
    assert [next(blocks)[1].leader.block_id for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(CameraTimeout):
        next(blocks)


def test_silence_matters_only_to_a_caller_who_waits() -> None:
    source = Source(fails_at=1)
    blocks = ReadAhead(source, 3, 1.0).blocks()
    next(blocks)
    time.sleep(0.1)  # meanwhile the source has timed out many times
    source.fails_at = 2
    assert next(blocks)[1].leader.block_id == 1
    with pytest.raises(CameraTimeout):
        next(blocks)


def test_closing_ends_the_thread() -> None:
    source = Source(silent_from=2)
    before = threading.active_count()
    blocks = ReadAhead(source, 10, 1.0).blocks()
    next(blocks)
    assert threading.active_count() == before + 1
    blocks.close()
    assert source.stopped.is_set()
    assert threading.active_count() == before
