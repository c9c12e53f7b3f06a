from __future__ import annotations

import struct

import pytest

from udccal.cameras.u3v.bootstrap import Bootstrap, read_bootstrap
from udccal.cameras.u3v.control import ControlChannel
from udccal.errors import CameraProtocolError

SENTENCE = r"Expected .* found .*\. \w+"
SBRM = 0x10000


class Link:
    """A device whose memory can be read, and which says what it was asked."""

    control_packet = 1024

    def __init__(self, **registers: object) -> None:
        values: dict[str, object] = {
            "vendor": b"Basler",
            "serial": b"22640524",
            "response_ms": 250,
            "sbrm": SBRM,
            "capability": 1,
            "command_bytes": 1024,
            "acknowledge_bytes": 512,
        }
        values |= registers
        self.memory = bytearray(SBRM + 0x100)
        put = struct.pack_into
        put("<64s", self.memory, 0x04, values["vendor"])
        put("<64s", self.memory, 0x44, b"acA2040-120uc")
        put("<64s", self.memory, 0x144, values["serial"])
        put("<IQQ", self.memory, 0x1CC, values["response_ms"], 0x20000, values["sbrm"])
        put("<Q", self.memory, SBRM + 0x04, values["capability"])
        put("<II", self.memory, SBRM + 0x14, values["command_bytes"], values["acknowledge_bytes"])
        put("<Q", self.memory, SBRM + 0x20, 0x30000)
        self.waits_s: list[float] = []
        self.asked: tuple[int, int, int] = (0, 0, 0)

    def send(self, command: bytes, timeout_s: float) -> None:
        address, _, length = struct.unpack_from("<QHH", command, 12)
        self.asked = (struct.unpack_from("<H", command, 10)[0], address, length)

    def receive(self, length: int, timeout_s: float) -> bytes:
        self.waits_s.append(timeout_s)
        request_id, address, count = self.asked
        data = self.memory[address : address + count].ljust(count, b"\0")
        return b"U3VC" + struct.pack("<HHHH", 0, 0x0801, count, request_id) + data

    def clear_control_halts(self) -> None:
        raise AssertionError("nothing is halted")


def test_who_it_is_and_where_the_rest_stands() -> None:
    link = Link()
    control = ControlChannel(link, 2.0)
    assert read_bootstrap(control) == Bootstrap("Basler", "acA2040-120uc", "22640524", 0x20000, 0x30000)
    assert link.waits_s[-1] == 0.25
    # 512 bytes of acknowledge hold 496 of data in whole words.
    link.waits_s.clear()
    control.read(0, 600)
    assert len(link.waits_s) == 2


def test_an_endless_response_time_is_bounded() -> None:
    link = Link(response_ms=0xFFFFFFFF)
    read_bootstrap(ControlChannel(link, 2.0))
    assert link.waits_s[-1] == 2.0


@pytest.mark.parametrize(
    ("raw", "text"),
    [(b"A" * 64, "A" * 64), (b"", ""), (b" 12\x07\n3 \0garbage", "123"), ("Größe".encode(), "Größe"), (b"\xff1", "�1")],
)
def test_strings_of_every_kind(raw: bytes, text: str) -> None:
    assert read_bootstrap(ControlChannel(Link(serial=raw), 2.0)).serial == text


@pytest.mark.parametrize(
    "registers",
    [{"capability": 0}, {"capability": 2}, {"acknowledge_bytes": 0}, {"command_bytes": 20}, {"sbrm": (1 << 64) - 2}],
)
def test_refuses_what_no_camera_says(registers: dict[str, int]) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        read_bootstrap(ControlChannel(Link(**registers), 2.0))
