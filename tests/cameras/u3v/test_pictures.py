from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from tests.cameras.u3v.toy_nodes import HEAD, TAIL, Registers, float_register, integer_register
from udccal.cameras.pixel_formats import PixelFormat, pixel_format
from udccal.cameras.protocol import Frame, Region, Settings
from udccal.cameras.u3v.nodes import NodeMap
from udccal.cameras.u3v.pictures import PictureReader
from udccal.cameras.u3v.receiver import Block
from udccal.cameras.u3v.stream import ImageInfo, Leader, PayloadType, Trailer
from udccal.errors import CameraError, CameraProtocolError

ROWS, COLUMNS = 6, 8
SETTINGS = Settings(4e-3, 3.0, Region(2, 4, COLUMNS, ROWS))
MONO8, MONO12P = pixel_format("Mono8"), pixel_format("Mono12p")
PICTURE = np.arange(1, ROWS * COLUMNS + 1, dtype=np.uint8)
XML = (
    HEAD
    + float_register("ChunkExposureTime", 0, "E")
    + '<Port Name="E"><ChunkID>A1</ChunkID></Port>'
    + float_register("ChunkGain", 0, "G")
    + '<Port Name="G"><ChunkID>A2</ChunkID></Port>'
    + integer_register("Unused", 0)
    + '<IntReg Name="ChunkTimestamp"><Address>0</Address><Length>8</Length><AccessMode>RO</AccessMode><pPort>T</pPort>'
    "<Sign>Unsigned</Sign><Endianess>LittleEndian</Endianess></IntReg>"
    '<Port Name="T"><ChunkID>A3</ChunkID></Port>' + TAIL
)


def reader(format: PixelFormat = MONO8, tick_s: float = 1e-9) -> PictureReader:
    return PictureReader(NodeMap(XML, Registers()), SETTINGS, format, tick_s)


def block(
    received: int,
    valid: int | None = None,
    *,
    format: PixelFormat = MONO8,
    kind: PayloadType = PayloadType.IMAGE,
    padding_x: int = 0,
    timestamp_ns: int = 5_000_000_000,
    rows: int | None = ROWS,
) -> Block:
    image = ImageInfo(format.code, COLUMNS, ROWS, 2, 4, padding_x)
    trailer = Trailer(9, 0, received if valid is None else valid, rows)
    return Block(Leader(9, kind, timestamp_ns, image), trailer, received)


def chunk(identifier: int, data: bytes) -> bytes:
    return data + struct.pack("<II", identifier, len(data))


def with_chunks(*chunks: bytes, timestamp_ns: int = 5_000_000_000) -> Frame:
    payload = chunk(1, PICTURE.tobytes()) + b"".join(chunks)
    taken = block(len(payload), kind=PayloadType.IMAGE_EXTENDED_CHUNK, timestamp_ns=timestamp_ns)
    return reader(tick_s=8e-9).frame(memoryview(bytearray(payload)), taken, 3)


def test_a_whole_picture() -> None:
    payload = memoryview(bytearray(PICTURE.tobytes() + bytes(16)))
    frame = reader().frame(payload, block(64, 48), 3)
    np.testing.assert_array_equal(frame.data, PICTURE.reshape(ROWS, COLUMNS))
    assert (frame.settings, frame.timestamp_s, frame.frame_id, frame.complete) == (SETTINGS, 5.0, 3, True)
    payload[:] = bytes(64)
    assert frame.data.any()


def test_what_is_missing_is_0_whatever_the_buffer_held() -> None:
    payload = memoryview(bytearray(PICTURE.tobytes()))
    frame = reader().frame(payload, block(35), 3)
    expected = np.where(np.arange(48) < 30, PICTURE, 0)  # down to whole samples of every packing
    np.testing.assert_array_equal(frame.data.ravel(), expected)
    assert not frame.complete


@pytest.mark.parametrize("received", range(0, 72, 7))
def test_no_sample_is_made_of_halves(received: int) -> None:
    bits = np.full(72, 0xFF, np.uint8)
    frame = reader(MONO12P).frame(memoryview(bytearray(bits)), block(received, format=MONO12P), 3)
    assert set(np.unique(frame.data)) <= {0, 4095}
    assert frame.complete == (received == 72)


def test_padded_lines() -> None:
    lines = b"".join(row.tobytes() + b"\xee\xee" for row in PICTURE.reshape(ROWS, COLUMNS))
    frame = reader().frame(memoryview(bytearray(lines)), block(60, padding_x=2), 3)
    np.testing.assert_array_equal(frame.data, PICTURE.reshape(ROWS, COLUMNS))
    frame = reader().frame(memoryview(bytearray(lines)), block(39, padding_x=2), 3)
    np.testing.assert_array_equal(frame.data[:3], PICTURE.reshape(ROWS, COLUMNS)[:3])
    assert not frame.data[3:].any()


@pytest.mark.parametrize(
    "taken",
    [
        replace(block(48), trailer=None),
        replace(block(48), trailer=Trailer(8, 0, 48, ROWS)),
        replace(block(48), trailer=Trailer(9, 0xA100, 48, ROWS)),
        block(48, 49),
        block(48, 47),
        block(48, rows=5),
        block(47),
        block(0),
    ],
    ids=range(8),
)
def test_incomplete_in_every_way(taken: Block) -> None:
    assert not reader().frame(memoryview(bytearray(PICTURE.tobytes())), taken, 3).complete


def test_a_trailer_without_rows_is_fine() -> None:
    assert reader().frame(memoryview(bytearray(PICTURE.tobytes())), block(48, rows=None), 3).complete


def test_chunks_say_exposure_gain_and_time() -> None:
    chunks = (
        chunk(0xA1, struct.pack("<d", 1500.0)),
        chunk(0xA2, struct.pack("<d", 6.5)),
        chunk(0xA3, b"\1" + bytes(7)),
    )
    frame = with_chunks(*chunks)
    assert (frame.settings.exposure_s, frame.settings.gain_dB) == (pytest.approx(1.5e-3), 6.5)
    assert (frame.timestamp_s, frame.complete) == (5.0, True)
    # A leader without a time leaves it to the chunk.
    assert with_chunks(*chunks, timestamp_ns=0).timestamp_s == 8e-9


def test_unknown_chunks_are_passed_over() -> None:
    frame = with_chunks(chunk(0xFF, b"whatever"))
    assert (frame.settings, frame.complete) == (SETTINGS, True)


@pytest.mark.parametrize(
    "chunks",
    [
        [chunk(0xA1, b"\0\0\0\0")],  # half a number
        [chunk(0xA1, struct.pack("<d", float("nan")))],
        [chunk(0xA1, struct.pack("<d", -1.0))],
        [chunk(0xA1, struct.pack("<d", 0.0))],
        [chunk(0xA2, struct.pack("<d", float("inf")))],
        [b"\0" * 4],
        [struct.pack("<II", 0xA1, 1 << 31)],
    ],
    ids=range(7),
)
def test_unsound_chunks_make_a_frame_incomplete_with_the_accepted_settings(chunks: list[bytes]) -> None:
    frame = with_chunks(*chunks)
    assert (frame.complete, frame.settings) == (False, SETTINGS)
    np.testing.assert_array_equal(frame.data, PICTURE.reshape(ROWS, COLUMNS))


@pytest.mark.parametrize(
    "image",
    [
        ImageInfo(MONO8.code, COLUMNS, ROWS - 1, 2, 4, 0),
        ImageInfo(MONO8.code, COLUMNS + 8, ROWS, 2, 4, 0),
        ImageInfo(MONO12P.code, COLUMNS, ROWS, 2, 4, 0),
        ImageInfo(0x12345678, COLUMNS, ROWS, 2, 4, 0),
        ImageInfo(MONO8.code, COLUMNS, ROWS, 2, 4, 65535),
        None,
    ],
    ids=range(6),
)
def test_another_picture_than_asked_for_is_refused(image: ImageInfo | None) -> None:
    taken = Block(Leader(9, PayloadType.IMAGE, 0, image), Trailer(9, 0, 48, ROWS), 48)
    with pytest.raises(CameraError, match=r"Expected .* found .*\. \w+"):
        reader().frame(memoryview(bytearray(PICTURE.tobytes())), taken, 3)


def test_the_error_for_another_picture_is_the_protocols() -> None:
    taken = Block(Leader(9, PayloadType.CHUNK, 0, None), Trailer(9, 0, 48, None), 48)
    with pytest.raises(CameraProtocolError, match="chunks alone"):
        reader().frame(memoryview(bytearray(PICTURE.tobytes())), taken, 3)
