from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from udccal.errors import FileFormatError
from udccal.io.png import read_png16, read_rgb8, write_png16, write_rgb8


@pytest.fixture
def mosaic() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 65536, (30, 44)).astype(np.uint16)


def test_mosaics_come_back_bit_for_bit(tmp_path: Path, mosaic: np.ndarray) -> None:
    write_png16(tmp_path / "a.png", mosaic)
    np.testing.assert_array_equal(read_png16(tmp_path / "a.png"), mosaic)


def test_rgb_keeps_its_order(tmp_path: Path) -> None:
    picture = np.zeros((4, 5, 3), np.uint8)
    picture[..., 0] = 200
    picture[0, 0] = (1, 2, 3)
    write_rgb8(tmp_path / "a.png", picture)
    np.testing.assert_array_equal(read_rgb8(tmp_path / "a.png"), picture)


@pytest.mark.parametrize("kept", [0.0, 0.02, 0.5, 0.99])
def test_truncated_files_are_refused(tmp_path: Path, mosaic: np.ndarray, kept: float) -> None:
    write_png16(tmp_path / "a.png", mosaic)
    content = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(content[: int(kept * len(content))])
    with pytest.raises(FileFormatError, match=r"Expected .* PNG file, found"):
        read_png16(tmp_path / "a.png")


def test_damaged_data_are_refused(tmp_path: Path, mosaic: np.ndarray) -> None:
    write_png16(tmp_path / "a.png", mosaic)
    content = bytearray((tmp_path / "a.png").read_bytes())
    content[len(content) // 2] ^= 0x10
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(FileFormatError, match="damaged data"):
        read_png16(tmp_path / "a.png")


def test_the_wrong_kind_of_png_is_refused(tmp_path: Path, mosaic: np.ndarray) -> None:
    write_png16(tmp_path / "a.png", mosaic)
    with pytest.raises(FileFormatError, match=r"Expected .* 8-bit RGB PNG, found 16 bits"):
        read_rgb8(tmp_path / "a.png")
    write_rgb8(tmp_path / "b.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(FileFormatError, match=r"Expected .* 16-bit greyscale PNG, found 8 bits"):
        read_png16(tmp_path / "b.png")
    with pytest.raises(FileFormatError, match="found none"):
        read_png16(tmp_path / "none.png")


def test_a_header_that_claims_a_huge_picture_is_refused_before_reading(tmp_path: Path, mosaic: np.ndarray) -> None:
    write_png16(tmp_path / "a.png", mosaic)
    content = bytearray((tmp_path / "a.png").read_bytes())
    content[16:20] = (60_000).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(FileFormatError, match="at most 160000000 pixels in all, found 60000 x 30"):
        read_png16(tmp_path / "a.png")


def test_a_colour_that_counts_as_transparent_changes_nothing(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (4, 5, 3)).astype(np.uint8)
    write_rgb8(tmp_path / "a.png", picture)
    content, body = (tmp_path / "a.png").read_bytes(), b"tRNS" + bytes([0, 1, 0, 2, 0, 3])
    chunk = struct.pack(">I", 6) + body + struct.pack(">I", zlib.crc32(body))
    (tmp_path / "a.png").write_bytes(content[:33] + chunk + content[33:])
    np.testing.assert_array_equal(read_rgb8(tmp_path / "a.png"), picture)


def test_samples_in_another_order_of_bytes_are_the_same(tmp_path: Path, mosaic: np.ndarray) -> None:
    write_png16(tmp_path / "a.png", mosaic.astype(">u2"))
    np.testing.assert_array_equal(read_png16(tmp_path / "a.png"), mosaic)
