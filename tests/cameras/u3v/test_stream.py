from __future__ import annotations

import pytest

from udccal.cameras.u3v.stream import ImageInfo, Leader, PayloadType, Trailer, parse_leader, parse_trailer
from udccal.errors import CameraProtocolError

SENTENCE = r"Expected .* found .*\. \w+"

LEADER = (
    "5533564c"  # U3VL
    "0000"
    "3400"  # 52 bytes
    "3300000000000000"  # block 51
    "0000"
    "0100"  # image
    "00ca9a3b00000000"  # 1 s
    "59000c01"  # BayerRG12p
    "00080000"  # 2048 columns
    "00060000"  # 1536 rows
    "10000000"  # x 16
    "08000000"  # y 8
    "0300"  # padding
    "0000"
)
TRAILER = (
    "55335654"  # U3VT
    "0000"
    "2000"  # 32 bytes
    "3300000000000000"  # block 51
    "0000"  # success
    "0000"
    "0000480000000000"  # 4718592 bytes
    "00060000"  # 1536 rows
)


def test_image_leader() -> None:
    leader = parse_leader(bytes.fromhex(LEADER))
    image = ImageInfo(0x010C0059, 2048, 1536, 16, 8, 3)
    assert leader == Leader(51, PayloadType.IMAGE, 1_000_000_000, image)


def test_leader_of_image_with_chunks_and_of_chunks_alone() -> None:
    with_chunks = LEADER[:36] + "0140" + LEADER[40:]
    assert parse_leader(bytes.fromhex(with_chunks)).payload_type is PayloadType.IMAGE_EXTENDED_CHUNK
    chunks = LEADER[:12] + "1c00" + LEADER[16:36] + "0040" + LEADER[40:56]
    assert parse_leader(bytes.fromhex(chunks)) == Leader(51, PayloadType.CHUNK, 1_000_000_000, None)


def test_leader_may_be_padded() -> None:
    assert parse_leader(bytes.fromhex(LEADER) + bytes(972)) == parse_leader(bytes.fromhex(LEADER))


def test_trailer() -> None:
    assert parse_trailer(bytes.fromhex(TRAILER)) == Trailer(51, 0, 4718592, 1536)


def test_trailer_with_chunk_layout_and_without_rows() -> None:
    with_layout = TRAILER[:12] + "2400" + TRAILER[16:] + "01000000"
    assert parse_trailer(bytes.fromhex(with_layout)) == Trailer(51, 0, 4718592, 1536)
    short = TRAILER[:12] + "1c00" + TRAILER[16:56]
    assert parse_trailer(bytes.fromhex(short)) == Trailer(51, 0, 4718592, None)


def test_trailer_says_that_data_was_thrown_away() -> None:
    assert parse_trailer(bytes.fromhex(TRAILER[:32] + "00a1" + TRAILER[36:])).status == 0xA100


@pytest.mark.parametrize(
    "packet",
    [
        "",
        "5533",
        "5533564c",
        LEADER[:-2],  # a byte is missing
        LEADER[:56],  # no image
        "5533564d" + LEADER[8:],
        TRAILER,
        LEADER[:12] + "3300" + LEADER[16:],  # says 51 bytes, which hold no image
        LEADER[:12] + "3500" + LEADER[16:],  # says 53 bytes
        LEADER[:12] + "0000" + LEADER[16:],
        LEADER[:36] + "0200" + LEADER[40:],  # a payload of type 2
        LEADER[:36] + "0110" + LEADER[40:],  # GenDC
    ],
)
def test_refuses_what_is_no_leader(packet: str) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        parse_leader(bytes.fromhex(packet))


@pytest.mark.parametrize(
    "packet",
    [
        "",
        "55335654",
        TRAILER[:54],
        TRAILER[:-2],  # says 32 bytes, has 31
        LEADER,
        TRAILER[:12] + "1b00" + TRAILER[16:],
        TRAILER[:12] + "ffff" + TRAILER[16:],
    ],
)
def test_refuses_what_is_no_trailer(packet: str) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        parse_trailer(bytes.fromhex(packet))
