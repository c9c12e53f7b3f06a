from __future__ import annotations

import struct
from array import array
from collections import deque

import pytest

from udccal.cameras.u3v.layout import plan_layout
from udccal.cameras.u3v.receiver import Block, Receiver
from udccal.cameras.u3v.usb_errors import EndpointHalted, TransferOverflow
from udccal.errors import CameraLost, CameraProtocolError, CameraTimeout

MIB = 1 << 20
PAYLOAD = MIB + 5000
PACKET = 1024
SENTENCE = r"Expected .* found .*\. \w+"


def leader(block_id: int, kind: int = 1) -> bytes:
    return struct.pack("<4sHHQHHQIIIIIHH", b"U3VL", 0, 52, block_id, 0, kind, 1000, 0x01080001, 8, 8, 0, 0, 0, 0)


def trailer(block_id: int, valid: int = PAYLOAD, status: int = 0) -> bytes:
    return struct.pack("<4sHHQHHQI", b"U3VT", 0, 32, block_id, status, 0, valid, 8)


def payload(block_id: int) -> bytes:
    return bytes((block_id * 31 + i) % 251 for i in range(251)) * (PAYLOAD // 251) + bytes(PAYLOAD % 251)


def sent(block_id: int) -> list[bytes | Exception]:
    data = payload(block_id)
    return [leader(block_id), data[:MIB], data[MIB:], trailer(block_id)]


class Link:
    """Gives out messages as a bus does: a message that is longer than the read goes on in the next one."""

    def __init__(self, *messages: bytes | Exception) -> None:
        self.waiting = deque(messages)
        self.cleared = 0
        self.waited_s = 0.0

    def read_stream(self, buffer: array[int], timeout_s: float) -> int:
        assert len(buffer) % PACKET == 0
        if not self.waiting:
            self.waited_s += timeout_s
            raise CameraTimeout("Expected data, found silence. Wait.")
        message = self.waiting.popleft()
        if isinstance(message, Exception):
            raise message
        part, rest = message[: len(buffer)], message[len(buffer) :]
        if rest:
            self.waiting.appendleft(rest)
        memoryview(buffer)[: len(part)] = part
        return len(part)

    def clear_stream_halt(self) -> None:
        self.cleared += 1


def receiver(*messages: bytes | Exception) -> tuple[Receiver, Link]:
    link = Link(*messages)
    return Receiver(link, plan_layout(PAYLOAD, 52, 32, PACKET), timeout_s=0.5), link


def taken(source: Receiver, wait_s: float = 1.0) -> tuple[Block, bytes]:
    buffer = bytearray(b"\xcc" * source.room)
    block = source.receive(memoryview(buffer), wait_s, lambda: False)
    assert block is not None
    return block, bytes(buffer[: block.received])


def halt() -> Exception:
    return EndpointHalted("Expected data, found a halt. Clear it.")


def overflow() -> Exception:
    return TransferOverflow("Expected less, found more. Retry.")


def test_blocks_come_whole_and_in_order() -> None:
    source, _ = receiver(*sent(0), *sent(1), *sent(2))
    for i in range(3):
        block, data = taken(source)
        assert block.whole
        assert (block.leader.block_id, block.valid, data) == (i, PAYLOAD, payload(i))


def test_padding_behind_the_payload_is_not_valid() -> None:
    source, _ = receiver(leader(0), payload(0)[:MIB], payload(0)[MIB:] + bytes(120), trailer(0))
    block, _ = taken(source)
    assert block.whole
    assert (block.received, block.valid) == (PAYLOAD + 120, PAYLOAD)


def test_a_payload_shorter_than_agreed_is_whole_when_the_trailer_says_so() -> None:
    source, _ = receiver(leader(0), payload(0)[:3000], trailer(0, valid=3000), *sent(1))
    block, data = taken(source)
    assert block.whole
    assert data == payload(0)[:3000]
    assert taken(source)[0].whole


def test_an_empty_packet_before_the_trailer_is_passed_over() -> None:
    source, _ = receiver(*sent(0)[:3], b"", trailer(0), *sent(1))
    assert taken(source)[0].whole
    assert taken(source)[0].whole


@pytest.mark.parametrize(
    ("messages", "received"),
    [
        ([leader(0), payload(0)[:4096], trailer(0)], 4096),  # the trailer says more came
        ([leader(0), payload(0)[:4096], trailer(0, 4096, status=0xA100)], 4096),
        ([*sent(0)[:3], trailer(7)], PAYLOAD),  # of another block
        (sent(0)[:3], PAYLOAD),  # no trailer; the next leader comes instead
        ([*sent(0)[:3], trailer(0)[:20]], PAYLOAD),
        ([*sent(0)[:3], b"neither leader nor trailer"], PAYLOAD),
        ([*sent(0)[:2], payload(0)[MIB:] + bytes(4096), trailer(0)], MIB + 5120),  # more than was agreed
        ([leader(0), payload(0)[:MIB], halt()], MIB),
        ([leader(0), payload(0)[:MIB], overflow()], MIB),
        ([*sent(0)[:3], halt()], PAYLOAD),
        ([leader(0), payload(0)[:8192]], 8192),  # and the next leader
        ([leader(0), payload(0)[:MIB]], MIB),
        ([leader(0), halt()], 0),
        ([leader(0), trailer(0, 0, status=0xA100)], 0),
    ],
    ids=range(14),
)
def test_broken_blocks_are_marked_and_the_next_is_whole(messages: list[bytes | Exception], received: int) -> None:
    source, _ = receiver(*messages, *sent(1), *sent(2))
    block, data = taken(source)
    assert not block.whole
    assert (block.leader.block_id, block.received) == (0, received)
    assert data[: min(received, PAYLOAD)] == payload(0)[:received]
    for i in (1, 2):
        block, data = taken(source)
        assert block.whole
        assert (block.leader.block_id, data) == (i, payload(i))


@pytest.mark.parametrize(
    "messages",
    [
        [leader(57)],  # left over; the next leader follows at once
        sent(0)[1:],  # no leader
        [trailer(0)],  # late
        [b"", b"\0" * 100],
        [leader(0)[:30], payload(0)[:MIB], trailer(0)],
        [leader(0, kind=9), payload(0)[:MIB], trailer(0)],
        [halt(), halt(), overflow()],
    ],
    ids=range(7),
)
def test_what_belongs_to_no_block_is_passed_over(messages: list[bytes | Exception]) -> None:
    source, _ = receiver(*messages, *sent(1), *sent(2))
    for i in (1, 2):
        block, data = taken(source)
        assert block.whole
        assert (block.leader.block_id, data) == (i, payload(i))


def test_repeated_blocks_are_passed_over() -> None:
    source, _ = receiver(*sent(4), *sent(4), *sent(3), *sent(6))
    assert [taken(source)[0].leader.block_id for _ in range(2)] == [4, 6]


def test_a_camera_that_repeats_itself_for_ever_is_an_error() -> None:
    source, _ = receiver(*(message for _ in range(40) for message in sent(4)))
    taken(source)
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        taken(source)


def test_halts_are_cleared() -> None:
    source, link = receiver(halt(), leader(0), payload(0)[:MIB], halt(), *sent(1))
    taken(source)
    taken(source)
    assert link.cleared == 2


def test_endless_halts_are_an_error() -> None:
    source, link = receiver(*(halt() for _ in range(500)))
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        taken(source)
    assert link.cleared < 50


def test_endless_data_without_leaders_is_an_error() -> None:
    source, link = receiver(*(payload(0) for _ in range(100)))
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        taken(source)
    assert len(link.waiting) > 80


def test_endless_leaders_of_an_unknown_payload_say_which() -> None:
    messages = [m for _ in range(50) for m in (leader(0, kind=0x1001), payload(0)[:MIB], payload(0)[MIB:], trailer(0))]
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        taken(receiver(*messages)[0])


def test_silence_is_a_time_out_after_the_time_given() -> None:
    source, link = receiver()
    with pytest.raises(CameraTimeout):
        taken(source, wait_s=1.5)
    assert link.waited_s == pytest.approx(1.5, abs=0.11)


def test_silence_in_the_middle_leaves_the_block_incomplete() -> None:
    source, link = receiver(leader(0), payload(0)[:MIB])
    block, _ = taken(source)
    assert (block.whole, block.received) == (False, MIB)
    assert link.waited_s == pytest.approx(0.5)


def test_a_lost_camera_is_told() -> None:
    source, _ = receiver(leader(0), payload(0)[:MIB], CameraLost("Expected a camera, found none. Plug it in."))
    with pytest.raises(CameraLost):
        taken(source)


def test_stops_when_told() -> None:
    source, link = receiver(*sent(0))
    assert source.receive(memoryview(bytearray(source.room)), 1.0, lambda: True) is None
    assert len(link.waiting) == 4


@pytest.mark.parametrize("kind", [0x000A, 0x000B])
def test_payloads_of_another_kind_are_named_whatever_came_last(kind: int) -> None:
    frames = [part for i in range(16) for part in (leader(i, kind), payload(i), trailer(i))]
    source, _ = receiver(*frames)
    with pytest.raises(CameraProtocolError, match=f"found type {kind:#06x}"):
        taken(source)
