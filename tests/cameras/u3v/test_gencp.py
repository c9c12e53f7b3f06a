from __future__ import annotations

import pytest

from udccal.cameras.u3v.gencp import (
    Acknowledge,
    Status,
    decode_acknowledge,
    encode_read,
    encode_write,
    pending_s,
    refusal,
    written_bytes,
)
from udccal.errors import CameraError, CameraProtocolError

SENTENCE = r"Expected .* found .*\. \w+"


def test_read_command_byte_by_byte() -> None:
    packet = encode_read(0x0102, 0x1122334455667788, 0x40)
    assert packet == bytes.fromhex(
        "55335643"  # U3VC
        "0040"  # acknowledge requested
        "0008"  # READMEM
        "0c00"  # 12 bytes follow
        "0201"  # request id
        "8877665544332211"  # address
        "0000"  # reserved
        "4000"  # 64 bytes
    )


def test_write_command_byte_by_byte() -> None:
    packet = encode_write(7, 0x10004, b"\xaa\xbb\xcc\xdd")
    assert packet == bytes.fromhex("55335643004002080c0007000400010000000000aabbccdd")


def test_read_acknowledge() -> None:
    packet = bytes.fromhex("55335643000001080400010001020304")
    assert decode_acknowledge(packet) == Acknowledge(0, 0x0801, 1, b"\x01\x02\x03\x04")


def test_refusing_acknowledge_without_data() -> None:
    packet = bytes.fromhex("55335643038001080000ffff")
    assert decode_acknowledge(packet) == Acknowledge(Status.INVALID_ADDRESS, 0x0801, 0xFFFF, b"")


def test_write_acknowledge_says_how_much_or_nothing() -> None:
    assert written_bytes(decode_acknowledge(bytes.fromhex("55335643000003080400010000000a00"))) == 10
    assert written_bytes(decode_acknowledge(bytes.fromhex("553356430000030800000100"))) is None


def test_pending_acknowledge_says_ms() -> None:
    assert pending_s(decode_acknowledge(bytes.fromhex("5533564300000508040001000000bc02"))) == 0.7


@pytest.mark.parametrize(
    "packet",
    [
        "",
        "55335643",
        "5533564300000108040001",  # 11 bytes
        "55335644000001080400010001020304",  # U3VD
        "00335643000001080400010001020304",
        "553356430000010804000100010203",  # one byte less than it says
        "5533564300000108040001000102030405",  # one more
        "5533564300000108ffff010001020304",
    ],
)
def test_refuses_what_is_no_acknowledge(packet: str) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        decode_acknowledge(bytes.fromhex(packet))


@pytest.mark.parametrize("data", [b"", b"\0\0\1", b"\0\0\1\0\0"])
def test_refuses_pending_acknowledges_of_another_length(data: bytes) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        pending_s(Acknowledge(0, 0x0805, 1, data))


@pytest.mark.parametrize("data", [b"\0", b"\0\0\1", b"\0\0\1\0\0"])
def test_refuses_write_acknowledges_of_another_length(data: bytes) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        written_bytes(Acknowledge(0, 0x0803, 1, data))


@pytest.mark.parametrize("status", [*(s for s in Status if s is not Status.SUCCESS), 0x8123, 0xFFFF])
def test_refusals_name_the_status_and_say_what_to_do(status: int) -> None:
    error = refusal(status, "a write of 4 bytes at 0x10")
    assert type(error) is CameraError
    name = Status(status).name if status in set(Status) else "unknown"
    assert str(error).startswith("Expected the camera to accept a write of 4 bytes at 0x10, found status " + name)
    assert str(error).count(". ") >= 1
