from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable

import pytest

from udccal.cameras.u3v.control import ControlChannel
from udccal.cameras.u3v.usb_errors import EndpointHalted, TransferOverflow
from udccal.errors import CameraError, CameraLost, CameraProtocolError, CameraTimeout

SENTENCE = r"Expected .* found .*\. \w+"
MEMORY = bytes(range(256)) * 16
Answer = bytes | Exception


def header(command: int, request_id: int, length: int, status: int = 0) -> bytes:
    return b"U3VC" + struct.pack("<HHHH", status, command, length, request_id)


def pending(request_id: int, ms: int) -> bytes:
    return header(0x0805, request_id, 4) + struct.pack("<HH", 0, ms)


def obedient(request_id: int, packet: bytes) -> list[Answer]:
    """What a device without faults answers."""
    command, address = struct.unpack_from("<H", packet, 6)[0], struct.unpack_from("<Q", packet, 12)[0]
    if command == 0x0800:
        length = struct.unpack_from("<H", packet, 22)[0]
        return [header(0x0801, request_id, length) + MEMORY[address : address + length]]
    return [header(0x0803, request_id, 4) + struct.pack("<HH", 0, len(packet) - 20)]


class Link:
    """Answers each command by a script, then as a device without faults."""

    control_packet = 512

    def __init__(self, *script: Callable[[int, bytes], list[Answer]]) -> None:
        self.script = deque(script)
        self.sent: list[bytes] = []
        self.waits_s: list[float] = []
        self.cleared = 0
        self.waiting: deque[Answer] = deque()

    def send(self, command: bytes, timeout_s: float) -> None:
        self.sent.append(command)
        answer = self.script.popleft() if self.script else obedient
        self.waiting.extend(answer(struct.unpack_from("<H", command, 10)[0], command))

    def receive(self, length: int, timeout_s: float) -> bytes:
        assert length % self.control_packet == 0
        self.waits_s.append(timeout_s)
        if not self.waiting:
            raise CameraTimeout("Expected an answer, found silence. Wait.")
        answer = self.waiting.popleft()
        if isinstance(answer, Exception):
            raise answer
        return answer

    def clear_control_halts(self) -> None:
        self.cleared += 1


def test_reads_and_writes() -> None:
    link = Link()
    channel = ControlChannel(link, 2.0)
    assert channel.read(16, 8) == MEMORY[16:24]
    channel.write(0x20, b"\1\2\3\4")
    assert link.sent[1] == bytes.fromhex("55335643004002080c000200200000000000000001020304")


def test_long_ranges_go_in_pieces_that_the_device_takes() -> None:
    link = Link()
    channel = ControlChannel(link, 2.0)
    channel.limit(0.2, 64, 36)
    assert channel.read(4, 100) == MEMORY[4:104]
    # 36 bytes of acknowledge hold 24 of data.
    assert [struct.unpack_from("<QHH", packet, 12) for packet in link.sent] == [
        (4 + start, 0, min(24, 100 - start)) for start in range(0, 100, 24)
    ]
    link.sent.clear()
    channel.write(8, MEMORY[:100])
    # 64 bytes of command hold 44 of data, of which whole words are 40.
    assert [len(packet) for packet in link.sent] == [60, 60, 40]
    assert b"".join(packet[20:] for packet in link.sent) == MEMORY[:100]


def test_ids_go_round_without_0() -> None:
    link = Link()
    channel = ControlChannel(link, 2.0)
    channel._request_id = 0xFFFD
    for _ in range(4):
        channel.read(0, 4)
    assert [struct.unpack_from("<H", packet, 10)[0] for packet in link.sent] == [0xFFFE, 0xFFFF, 1, 2]


def test_passes_over_stale_acknowledges() -> None:
    link = Link(lambda i, p: [header(0x0801, i - 1, 4) + b"old!", pending(i - 1, 9), *obedient(i, p)])
    assert ControlChannel(link, 2.0).read(8, 4) == MEMORY[8:12]


def test_gives_up_on_endless_stale_acknowledges() -> None:
    flood = [header(0x0801, 0, 4) + b"old!"] * 100
    link = Link(*[lambda i, p: list(flood)] * 3)
    with pytest.raises(CameraTimeout, match=SENTENCE):
        ControlChannel(link, 2.0).read(8, 4)
    assert len(link.sent) == 3


def test_pending_acknowledge_extends_the_wait() -> None:
    link = Link(lambda i, p: [pending(i, 3000), pending(i, 0), *obedient(i, p)])
    channel = ControlChannel(link, 2.0)
    channel.limit(0.25, 128, 128)
    assert channel.read(8, 4) == MEMORY[8:12]
    assert link.waits_s == pytest.approx([0.25, 3.25, 0.25])
    assert len(link.sent) == 1


def test_patience_is_bounded_in_count_and_time() -> None:
    link = Link(*[lambda i, p: [pending(i, 65_535)] * 500] * 3)
    channel = ControlChannel(link, 2.0)
    with pytest.raises(CameraTimeout, match="more time"):
        channel.read(8, 4)
    assert len(link.waits_s) <= 3 * 101
    assert max(link.waits_s) <= 17.0


@pytest.mark.parametrize(
    "fault",
    [
        lambda i, p: [],  # lost
        lambda i, p: [EndpointHalted("Expected data, found a halt. Clear it.")],
        lambda i, p: [TransferOverflow("Expected less, found more. Retry.")],
        lambda i, p: [b"U3VD" + obedient(i, p)[0][4:]],  # type: ignore[index]
        lambda i, p: [obedient(i, p)[0][:7]],  # type: ignore[index]
        lambda i, p: [header(0x0803, i, 4) + b"\0\0\4\0"],  # acknowledge of a write
        lambda i, p: [header(0x0805, i, 0)],  # pending without a time
    ],
)
def test_tries_again_twice(fault: Callable[[int, bytes], list[Answer]]) -> None:
    link = Link(fault, fault)
    channel = ControlChannel(link, 2.0)
    assert channel.read(8, 4) == MEMORY[8:12]
    assert channel.resent == 2
    # The same command with the same id, so that a device can tell.
    assert len(set(link.sent)) == 1
    link = Link(fault, fault, fault)
    with pytest.raises(CameraError, match=SENTENCE):
        ControlChannel(link, 2.0).read(8, 4)
    assert len(link.sent) == 3


def test_a_busy_device_is_asked_again_until_the_time_out() -> None:
    def busy(request_id: int, packet: bytes) -> list[Answer]:
        return [header(0x0801, request_id, 0, status=0x8007)]

    link = Link(*[busy] * 8)
    channel = ControlChannel(link, 2.0)
    assert channel.read(8, 4) == MEMORY[8:12]
    # It has refused, and so executed none of them.
    assert (len(link.sent), channel.resent) == (9, 0)
    with pytest.raises(CameraError, match="BUSY"):
        ControlChannel(Link(*[busy] * 1000), 0.1).read(8, 4)


def test_clears_halts() -> None:
    link = Link(lambda i, p: [EndpointHalted("Expected data, found a halt. Clear it.")])
    ControlChannel(link, 2.0).read(8, 4)
    assert link.cleared == 1


def test_refusals_are_told_at_once() -> None:
    link = Link(lambda i, p: [header(0x0803, i, 0, status=0x8004)])
    with pytest.raises(CameraError, match="WRITE_PROTECT"):
        ControlChannel(link, 2.0).write(8, b"\0\0\0\0")
    assert len(link.sent) == 1


def test_a_lost_camera_is_told_at_once() -> None:
    link = Link(lambda i, p: [CameraLost("Expected a camera, found none. Plug it in.")])
    with pytest.raises(CameraLost):
        ControlChannel(link, 2.0).read(8, 4)
    assert len(link.sent) == 1


@pytest.mark.parametrize("length", [0, 3, 5])
def test_refuses_data_of_another_length(length: int) -> None:
    link = Link(lambda i, p: [header(0x0801, i, length) + bytes(length)])
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        ControlChannel(link, 2.0).read(8, 4)


def test_refuses_writes_that_were_done_in_part() -> None:
    link = Link(lambda i, p: [header(0x0803, i, 4) + b"\0\0\3\0"])
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        ControlChannel(link, 2.0).write(8, b"\0\0\0\0")


def test_accepts_writes_of_which_the_device_does_not_say_how_much() -> None:
    link = Link(lambda i, p: [header(0x0803, i, 0)])
    ControlChannel(link, 2.0).write(8, b"\0\0\0\0")
    assert len(link.sent) == 1


@pytest.mark.parametrize(("address", "length"), [(-1, 4), ((1 << 64) - 3, 4), (1 << 64, 1)])
def test_refuses_addresses_beyond_64_bits(address: int, length: int) -> None:
    link = Link()
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        ControlChannel(link, 2.0).read(address, length)
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        ControlChannel(link, 2.0).write(address, bytes(length))
    assert not link.sent


@pytest.mark.parametrize("sizes", [(31, 1024), (1024, 31), (0, 0)])
def test_refuses_devices_with_messages_that_hold_nothing(sizes: tuple[int, int]) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        ControlChannel(Link(), 2.0).limit(0.1, *sizes)


def test_claims_of_the_device_are_bounded() -> None:
    link = Link()
    channel = ControlChannel(link, 2.0)
    channel.limit(0.0, 1 << 31, 1 << 31)
    channel.read(0, 4096)
    channel.limit(3600.0, 128, 128)
    channel.read(0, 4)
    assert link.waits_s == [0.1, 2.0]
    assert len(link.sent) == 2


def test_the_last_attempt_waits_longest() -> None:
    link = Link(*[lambda i, p: []] * 3)
    channel = ControlChannel(link, 2.0)
    channel.limit(0.2, 128, 128)
    with pytest.raises(CameraTimeout):
        channel.read(0, 4)
    assert link.waits_s == [0.2, 0.2, 2.0]
