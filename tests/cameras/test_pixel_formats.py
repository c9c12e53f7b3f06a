from __future__ import annotations

import numpy as np
import pytest

from udccal.cameras.pixel_formats import (
    PIXEL_FORMATS,
    PixelFormat,
    payload_bytes,
    pixel_format,
    pixel_format_of,
    unpack,
)
from udccal.errors import CameraError

SHAPES = [(2, 4), (3, 5), (1, 1), (7, 3), (4, 16), (5, 6)]


def packed_bit_by_bit(samples: list[int], format: PixelFormat) -> bytes:
    """One line of samples as text of ones and zeros, lowest bit first, then cut into bytes."""
    if format.name.endswith("Packed"):
        return packed_nibble_by_nibble(samples)
    bits = "".join(f"{value:0{format.bits_per_pixel}b}"[::-1] for value in samples)
    bits += "0" * (-len(bits) % 8)
    return bytes(int(bits[i : i + 8][::-1], 2) for i in range(0, len(bits), 8))


def packed_nibble_by_nibble(samples: list[int]) -> bytes:
    """GigE Vision's 12 bits: in hexadecimal ABC and DEF are written AB FC DE."""
    text = ""
    for i in range(0, len(samples), 2):
        first = f"{samples[i]:03x}"
        second = f"{samples[i + 1]:03x}" if i + 1 < len(samples) else "000"
        text += first[:2] + second[2] + first[2] + (second[:2] if i + 1 < len(samples) else "")
    return bytes.fromhex(text)


def picture(format: PixelFormat, shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 1 << format.bits, shape, dtype=np.uint16)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", PIXEL_FORMATS)
def test_unpacks_what_was_packed_bit_by_bit(name: str, shape: tuple[int, int]) -> None:
    format = pixel_format(name)
    samples = picture(format, shape)
    packed = packed_bit_by_bit(samples.ravel().tolist(), format)
    assert len(packed) == payload_bytes(format, *shape)
    np.testing.assert_array_equal(unpack(packed, format, *shape), samples)
    np.testing.assert_array_equal(unpack(packed + b"\xff" * 9, format, *shape), samples)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", ["Mono8", "BayerRG12", "Mono10p", "BayerGB12p", "Mono12Packed"])
def test_padded_lines_start_on_whole_bytes(name: str, shape: tuple[int, int]) -> None:
    format = pixel_format(name)
    samples = picture(format, shape, seed=1)
    packed = b"".join(packed_bit_by_bit(line, format) + b"\xff\xff\xff" for line in samples.tolist())
    assert len(packed) == payload_bytes(format, *shape, padding_x=3)
    np.testing.assert_array_equal(unpack(packed, format, *shape, padding_x=3), samples)


def test_known_bytes() -> None:
    assert unpack(bytes.fromhex("bcfade"), pixel_format("Mono12p"), 1, 2).tolist() == [[0xABC, 0xDEF]]
    assert unpack(bytes.fromhex("abfcde"), pixel_format("Mono12Packed"), 1, 2).tolist() == [[0xABC, 0xDEF]]
    # 0x3FF, 0, 0x3FF, 1 in ten bits each, lowest first
    assert unpack(bytes.fromhex("ff03f07f00"), pixel_format("Mono10p"), 1, 4).tolist() == [[0x3FF, 0, 0x3FF, 1]]
    assert unpack(bytes.fromhex("bc0aef0d"), pixel_format("BayerRG12"), 2, 1).tolist() == [[0xABC], [0xDEF]]


@pytest.mark.parametrize("buffer", [bytes(12), bytearray(12), memoryview(bytes(12)), np.zeros(12, np.uint8)])
@pytest.mark.parametrize("name", ["Mono8", "Mono12", "Mono12p", "Mono12Packed"])
def test_result_is_a_writable_copy(buffer: object, name: str) -> None:
    samples = unpack(buffer, pixel_format(name), 2, 3)  # type: ignore[arg-type]
    assert samples.flags.writeable
    assert samples.flags.c_contiguous
    samples[:] = 7
    assert not np.frombuffer(buffer, np.uint8).any()  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("name", "code", "bits", "cfa", "bits_per_pixel", "packed"),
    [
        ("Mono8", 0x01080001, 8, "mono", 8, False),
        ("Mono12p", 0x010C0047, 12, "mono", 12, True),
        ("BayerRG12p", 0x010C0059, 12, "RGGB", 12, True),
        ("BayerGB10p", 0x010A0054, 10, "GBRG", 10, True),
        ("BayerBG10", 0x0110000F, 10, "BGGR", 16, False),
        ("BayerGR16", 0x0110002E, 16, "GRBG", 16, False),
        ("Mono12Packed", 0x010C0006, 12, "mono", 12, True),
    ],
)
def test_formats_are_those_of_the_convention(
    name: str, code: int, bits: int, cfa: str, bits_per_pixel: int, packed: bool
) -> None:
    format = pixel_format(name)
    assert format is pixel_format_of(code)
    assert (format.bits, format.cfa, format.bits_per_pixel, format.packed) == (bits, cfa, bits_per_pixel, packed)


def test_codes_are_unique_and_say_the_bits() -> None:
    formats = PIXEL_FORMATS.values()
    assert len({f.code for f in formats}) == len(formats) == 35
    for format in formats:
        assert format.bits_per_pixel == (format.bits if format.packed or format.bits == 8 else 16)


@pytest.mark.parametrize("name", ["", "RGB8", "Mono12P", "bayerrg8", "Mono14", "Mono" * 1000])
def test_refuses_names_it_does_not_know(name: str) -> None:
    with pytest.raises(CameraError, match=r"Expected .* found .*\. \w+") as caught:
        pixel_format(name)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("code", [0, -1, 0x02180014, 1 << 40])
def test_refuses_codes_it_does_not_know(code: int) -> None:
    with pytest.raises(CameraError, match=r"Expected .* found .*\. \w+"):
        pixel_format_of(code)


@pytest.mark.parametrize("name", PIXEL_FORMATS)
def test_refuses_short_buffers(name: str) -> None:
    format = pixel_format(name)
    with pytest.raises(CameraError, match=r"Expected .* bytes"):
        unpack(bytes(payload_bytes(format, 3, 5) - 1), format, 3, 5)
    with pytest.raises(CameraError, match=r"Expected .* bytes"):
        unpack(bytes(payload_bytes(format, 3, 5, 2) - 1), format, 3, 5, padding_x=2)


@pytest.mark.parametrize(("rows", "columns", "padding_x"), [(0, 4, 0), (4, 0, 0), (-1, -4, 0), (2, 2, -1)])
def test_refuses_empty_pictures(rows: int, columns: int, padding_x: int) -> None:
    with pytest.raises(CameraError):
        unpack(bytes(64), pixel_format("Mono12p"), rows, columns, padding_x)
