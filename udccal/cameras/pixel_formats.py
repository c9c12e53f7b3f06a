"""Pixel formats of the GenICam Pixel Format Naming Convention (PFNC): names, codes, and unpacking of samples.

This module knows Mono and Bayer in three layouts: 8, 10, 12 and 16 bits in whole bytes, little-endian with the samples
in the low bits; 10 and 12 bits packed from the lowest bit on (names ending in ``p``); and GigE Vision's older packing
of 12 bits (``Packed``: high bits of the first sample, low bits of both, high bits of the second).
"""

from __future__ import annotations

import enum
import re
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from jaxtyping import UInt8, UInt16

from udccal.cfa import PATTERNS
from udccal.errors import CameraError

# Four samples of 10 or 12 bits are 5 or 6 whole bytes, and four 16-bit results fill one 64-bit word.
_GROUP: Final = 4
_WORD_BYTES: Final = 8


@final
class Packing(enum.Enum):
    """Layout of samples in memory; the values are the endings of PFNC's names."""

    BYTES = ""
    LSB = "p"
    GIGE = "Packed"


@final
@dataclass(frozen=True)
class PixelFormat:
    """One pixel format.

    Attributes:
        name: PFNC's name, which is also the value of SFNC's feature ``PixelFormat``.
        code: PFNC's 32-bit value; bits 16 to 23 hold the bits that a pixel takes in memory.
        bits: significant bits per sample.
        cfa: pattern of the top-left 2 x 2, e.g. ``RGGB``; ``mono`` for none.
    """

    name: str
    code: int
    bits: int
    cfa: str
    packing: Packing

    @property
    def bits_per_pixel(self) -> int:
        """Bits of a pixel in memory."""
        return (self.code >> 16) & 0xFF

    @property
    def packed(self) -> bool:
        """Whether samples share bytes."""
        return self.packing is not Packing.BYTES


_CFA: Final = {pattern.family: name for name, pattern in PATTERNS.items()}

# PFNC's own order of patterns differs from one family of codes to the next.
_CODES: Final = {
    "Mono8": 0x01080001,
    "Mono10": 0x01100003,
    "Mono12": 0x01100005,
    "Mono16": 0x01100007,
    "Mono10p": 0x010A0046,
    "Mono12p": 0x010C0047,
    "Mono12Packed": 0x010C0006,
    "BayerGR8": 0x01080008,
    "BayerRG8": 0x01080009,
    "BayerGB8": 0x0108000A,
    "BayerBG8": 0x0108000B,
    "BayerGR10": 0x0110000C,
    "BayerRG10": 0x0110000D,
    "BayerGB10": 0x0110000E,
    "BayerBG10": 0x0110000F,
    "BayerGR12": 0x01100010,
    "BayerRG12": 0x01100011,
    "BayerGB12": 0x01100012,
    "BayerBG12": 0x01100013,
    "BayerGR16": 0x0110002E,
    "BayerRG16": 0x0110002F,
    "BayerGB16": 0x01100030,
    "BayerBG16": 0x01100031,
    "BayerBG10p": 0x010A0052,
    "BayerBG12p": 0x010C0053,
    "BayerGB10p": 0x010A0054,
    "BayerGB12p": 0x010C0055,
    "BayerGR10p": 0x010A0056,
    "BayerGR12p": 0x010C0057,
    "BayerRG10p": 0x010A0058,
    "BayerRG12p": 0x010C0059,
    "BayerGR12Packed": 0x010C002A,
    "BayerRG12Packed": 0x010C002B,
    "BayerGB12Packed": 0x010C002C,
    "BayerBG12Packed": 0x010C002D,
}


def _format(name: str, code: int) -> PixelFormat:
    family, digits, packing = re.split(r"(\d+)", name)
    return PixelFormat(name, code, int(digits), _CFA[family], Packing(packing))


PIXEL_FORMATS: Final = {name: _format(name, code) for name, code in _CODES.items()}
_BY_CODE: Final = {format.code: format for format in PIXEL_FORMATS.values()}


def pixel_format(name: str) -> PixelFormat:
    """Return the format with the PFNC name ``name``.

    Raises:
        CameraError: when this module cannot unpack it.
    """
    if name not in PIXEL_FORMATS:
        raise CameraError(
            f"Expected a Mono or Bayer pixel format of 8 to 16 bits, found {name[:40]!r}. "
            "Choose one that the camera and this program both know, e.g. BayerRG12p or Mono12."
        )
    return PIXEL_FORMATS[name]


def pixel_format_of(code: int) -> PixelFormat:
    """Return the format with the 32-bit PFNC code ``code``.

    Raises:
        CameraError: when this module cannot unpack it.
    """
    if code not in _BY_CODE:
        raise CameraError(
            f"Expected the PFNC code of a Mono or Bayer format of 8 to 16 bits, found {code:#010x}. "
            "Set the camera's PixelFormat to one that this program knows, e.g. BayerRG12p or Mono12."
        )
    return _BY_CODE[code]


def payload_bytes(format: PixelFormat, rows: int, columns: int, padding_x: int = 0) -> int:
    """Return the bytes of a picture; bit-packed samples continue from line to line unless lines are padded.

    Args:
        padding_x: bytes after the end of each line, after the leader of USB3 Vision and GigE Vision; padded lines start
            on whole bytes.
    """
    if padding_x:
        return rows * _stride(format, columns, padding_x)
    return -(-rows * columns * format.bits_per_pixel // 8)


def unpack(
    buffer: bytes | bytearray | memoryview | UInt8[np.ndarray, " bytes"],
    format: PixelFormat,
    rows: int,
    columns: int,
    padding_x: int = 0,
) -> UInt16[np.ndarray, "rows columns"]:
    """Unpack the samples in a buffer into a new array, right-aligned in 16 bits, in DN.

    Args:
        buffer: bytes of the picture; bytes beyond it are ignored.
        format: layout of the samples.
        rows: rows of the picture.
        columns: columns of the picture.
        padding_x: bytes after the end of each line.

    Raises:
        CameraError: when the picture is empty, or the buffer is shorter than it.
    """
    needed = payload_bytes(format, rows, columns, padding_x)
    data = np.frombuffer(buffer, np.uint8)
    if rows < 1 or columns < 1 or padding_x < 0 or data.size < needed:
        raise CameraError(
            f"Expected {needed} bytes of {format.name} for {columns} x {rows} pixels, found {data.size}. "
            "Check the camera's region and the cable."
        )
    if padding_x:
        lines = data[:needed].reshape(rows, _stride(format, columns, padding_x))
        return _samples(lines, format, columns)
    return _samples(data[None, :needed], format, rows * columns).reshape(rows, columns)


def _stride(format: PixelFormat, columns: int, padding_x: int) -> int:
    return -(-columns * format.bits_per_pixel // 8) + padding_x


def _samples(lines: UInt8[np.ndarray, "lines bytes"], format: PixelFormat, count: int) -> UInt16[np.ndarray, "lines n"]:
    """Return the first ``count`` samples of each line."""
    if format.packing is Packing.LSB:
        return _lsb_packed(lines, format.bits, count)
    if format.packing is Packing.GIGE:
        return _gige_packed(lines, count)
    if format.bits_per_pixel == 8:
        return lines[:, :count].astype(np.uint16)
    return np.ascontiguousarray(lines[:, : 2 * count]).view("<u2").astype(np.uint16)


def _lsb_packed(lines: UInt8[np.ndarray, "lines bytes"], bits: int, count: int) -> UInt16[np.ndarray, "lines n"]:
    """Unpack four samples at a time: read each group of bytes as one 64-bit word and move its samples 16 bits apart."""
    groups, size = -(-count // _GROUP), _GROUP * bits // 8
    # A word extends past its group, so the last group of the last line needs bytes after it.
    room = np.zeros((len(lines), max(groups * size, lines.shape[1]) + _WORD_BYTES), np.uint8)
    room[:, : lines.shape[1]] = lines
    words = np.ndarray((len(lines), groups), "<u8", room.data, strides=(room.strides[0], size)).astype(np.uint64)
    mask = (1 << bits) - 1
    spread = words & mask
    field = np.empty_like(words)
    for i in range(1, _GROUP):
        np.bitwise_and(words, mask << (i * bits), out=field)
        np.left_shift(field, i * (16 - bits), out=field)
        np.bitwise_or(spread, field, out=spread)
    # Little-endian whatever the machine, so that the first sample of a word comes first.
    samples = spread.astype("<u8", copy=False).view("<u2").astype(np.uint16, copy=False)
    return samples if samples.shape[1] == count else samples[:, :count].copy()


def _gige_packed(lines: UInt8[np.ndarray, "lines bytes"], count: int) -> UInt16[np.ndarray, "lines n"]:
    pairs = -(-count // 2)
    room = np.zeros((len(lines), max(3 * pairs, lines.shape[1])), np.uint8)
    room[:, : lines.shape[1]] = lines
    high_0, low, high_1 = np.moveaxis(room[:, : 3 * pairs].reshape(len(lines), pairs, 3).astype(np.uint16), -1, 0)
    samples = np.empty((len(lines), pairs, 2), np.uint16)
    samples[..., 0] = (high_0 << 4) | (low & 0xF)
    samples[..., 1] = (high_1 << 4) | (low >> 4)
    return samples.reshape(len(lines), -1)[:, :count].copy()
