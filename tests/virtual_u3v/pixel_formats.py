"""Pixel formats by their GenICam PFNC names and codes, and how samples are laid out in each."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import UInt8, UInt16

from tests.virtual_u3v.model import CameraModel

# PFNC's names of CFA patterns: the colours of the first row's first two samples.
_BAYER = {"RGGB": "BayerRG", "GRBG": "BayerGR", "GBRG": "BayerGB", "BGGR": "BayerBG", "mono": "Mono"}
# Codes of PFNC 2.x: 0x01 (one component), bits per pixel, number.
_CODES = {
    "Mono8": 0x01080001, "Mono10": 0x01100003, "Mono10p": 0x010A0046,
    "Mono12": 0x01100005, "Mono12p": 0x010C0047, "Mono16": 0x01100007,
    "BayerGR8": 0x01080008, "BayerGR10": 0x0110000C, "BayerGR10p": 0x010A0056,
    "BayerGR12": 0x01100010, "BayerGR12p": 0x010C0057, "BayerGR16": 0x0110002E,
    "BayerRG8": 0x01080009, "BayerRG10": 0x0110000D, "BayerRG10p": 0x010A0058,
    "BayerRG12": 0x01100011, "BayerRG12p": 0x010C0059, "BayerRG16": 0x0110002F,
    "BayerGB8": 0x0108000A, "BayerGB10": 0x0110000E, "BayerGB10p": 0x010A0054,
    "BayerGB12": 0x01100012, "BayerGB12p": 0x010C0055, "BayerGB16": 0x01100030,
    "BayerBG8": 0x0108000B, "BayerBG10": 0x0110000F, "BayerBG10p": 0x010A0052,
    "BayerBG12": 0x01100013, "BayerBG12p": 0x010C0053, "BayerBG16": 0x01100031,
}  # fmt: skip
_SUFFIXES = ("8", "10", "10p", "12", "12p", "16")
_CACHED_FRAMES = 8


@dataclass(frozen=True)
class PixelFormat:
    """A pixel format.

    Attributes:
        bits: of a sample.
        bits_per_pixel: that a sample takes in the payload.
    """

    name: str
    code: int

    @property
    def bits(self) -> int:
        return int("".join(c for c in self.name if c.isdigit()))

    @property
    def bits_per_pixel(self) -> int:
        return (self.code >> 16) & 0xFF


def formats_of(model: CameraModel) -> tuple[PixelFormat, ...]:
    """What a camera offers: the sensor's pattern in every depth."""
    names = (_BAYER[model.cfa] + suffix for suffix in _SUFFIXES)
    return tuple(PixelFormat(name, _CODES[name]) for name in names)


def delivered(
    mosaic: UInt16[np.ndarray, "rows columns"], sensor_bits: int, sample_bits: int
) -> UInt16[np.ndarray, "rows columns"]:
    """The samples as a format of ``sample_bits`` carries them: the converter's highest bits, left-justified."""
    surplus = sensor_bits - sample_bits
    return mosaic >> surplus if surplus >= 0 else mosaic << -surplus


def pack(samples: UInt16[np.ndarray, "rows columns"], pixel_format: PixelFormat) -> bytes:
    """Samples as bytes, little endian; ``p`` formats run without gaps from the lowest bit on (PFNC 2.x §5)."""
    flat = samples.reshape(-1)
    if pixel_format.bits_per_pixel == 8:
        return flat.astype(np.uint8).tobytes()
    if pixel_format.bits_per_pixel == 16:
        return flat.astype("<u2").tobytes()
    return (_packed12 if pixel_format.bits == 12 else _packed10)(flat).tobytes()


def _packed12(flat: UInt16[np.ndarray, " samples"]) -> UInt8[np.ndarray, "pairs 3"]:
    low, high = flat[0::2], flat[1::2]
    out = np.empty((low.size, 3), np.uint8)
    out[:, 0] = low & 0xFF
    out[:, 1] = (low >> 8) | ((high & 0xF) << 4)
    out[:, 2] = high >> 4
    return out


def _packed10(flat: UInt16[np.ndarray, " samples"]) -> UInt8[np.ndarray, "quads 5"]:
    quads = flat.reshape(-1, 4).astype(np.uint64)
    word = quads[:, 0] | quads[:, 1] << 10 | quads[:, 2] << 20 | quads[:, 3] << 30
    return np.ascontiguousarray(word.astype("<u8")).view(np.uint8).reshape(-1, 8)[:, :5]


@final
class Packer:
    """Packs frames; what it made of a read-only mosaic it remembers, so that a source may hand out the same again."""

    def __init__(self, sensor_bits: int) -> None:
        self._sensor_bits = sensor_bits
        self._kept: OrderedDict[tuple[int, str], tuple[np.ndarray, bytes]] = OrderedDict()

    def payload(self, mosaic: UInt16[np.ndarray, "rows columns"], pixel_format: PixelFormat) -> bytes:
        """A mosaic of the sensor's depth as the payload's bytes."""
        key = (id(mosaic), pixel_format.name)
        if key in self._kept:  # the mosaic is kept too, so that no other array can have its id
            return self._kept[key][1]
        data = pack(delivered(mosaic, self._sensor_bits, pixel_format.bits), pixel_format)
        if not mosaic.flags.writeable:
            self._kept[key] = (mosaic, data)
            while len(self._kept) > _CACHED_FRAMES:
                self._kept.popitem(last=False)
        return data
