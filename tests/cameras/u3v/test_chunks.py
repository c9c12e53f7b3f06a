from __future__ import annotations

import random

import pytest

from udccal.cameras.u3v.chunks import Chunk, behind_picture, parse_chunks
from udccal.errors import CameraProtocolError

SENTENCE = r"Expected .* found .*\. \w+"

# Six bytes of picture with two of padding as chunk 1, then 8 bytes as chunk 0xA001, then 4 as chunk 0xA002.
PICTURE = "01020304050600000100000008000000"
EXPOSURE = "000000000000594001a0000008000000"
GAIN = "0000404002a0000004000000"


def test_chunks_are_found_from_the_end() -> None:
    payload = memoryview(bytes.fromhex(PICTURE + EXPOSURE + GAIN))
    assert parse_chunks(payload) == (Chunk(1, 0, 8), Chunk(0xA001, 16, 8), Chunk(0xA002, 32, 4))


def test_empty_payload_has_none() -> None:
    assert parse_chunks(memoryview(b"")) == ()


def test_chunks_behind_the_picture_are_sound_by_themselves() -> None:
    payload = memoryview(bytes.fromhex(PICTURE + EXPOSURE + GAIN))
    assert behind_picture(payload, 6) == bytes.fromhex(EXPOSURE + GAIN)
    assert behind_picture(memoryview(bytes.fromhex(PICTURE)), 8) == b""


@pytest.mark.parametrize(
    "payload",
    [
        "00",
        "01000000080000",  # 7 bytes
        PICTURE[2:],  # its length reaches beyond the beginning
        "ff" + PICTURE,  # a byte that belongs to no chunk
        PICTURE + EXPOSURE[:-2],
        "01000000ffffffff",
        PICTURE + "02a0000011000000",
        "0000000000000000" * 257,  # 257 empty chunks
    ],
)
def test_refuses_unsound_chunks(payload: str) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        parse_chunks(memoryview(bytes.fromhex(payload)))


def test_refuses_a_picture_that_is_too_short() -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        behind_picture(memoryview(bytes.fromhex(PICTURE + EXPOSURE)), 9)
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        behind_picture(memoryview(b""), 1)


def test_random_bytes_are_chunks_or_refused() -> None:
    """And whatever is accepted fills the payload without gap or overlap."""
    drawn = random.Random(0)
    accepted = 0
    for _ in range(20_000):
        payload = bytes(drawn.choice((0, 0, 0, 4, 8)) for _ in range(drawn.randrange(40)))
        try:
            chunks = parse_chunks(memoryview(payload))
        except CameraProtocolError:
            continue
        accepted += bool(chunks)
        assert sum(chunk.length + 8 for chunk in chunks) == len(payload)
        ends = [chunk.start + chunk.length + 8 for chunk in chunks]
        assert [chunk.start for chunk in chunks] == [0, *ends][: len(chunks)]
    assert accepted > 100
