"""Chunk data: what a frame carries besides its image (SFNC 2.x §18; layout of USB3 Vision 1.0 §5.6)."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from tests.virtual_u3v import xml_nodes as xml

_IMAGE_ID = 0x0000_0001
_ALIGNMENT = 4


@dataclass(frozen=True)
class Chunk:
    """A kind of chunk.

    Attributes:
        name: in ChunkSelector.
        id: before which it stands in the payload.
        feature: SFNC's name of its value; empty for the image.
        length: of its value in bytes.
        unit: of its value.
        real: whether the value is a double, not an integer.
    """

    name: str
    id: int
    feature: str = ""
    length: int = 8
    unit: str = ""
    real: bool = False

    def nodes(self) -> str:
        """The value and the chunk's port in the description."""
        place = (("Address", 0), ("Length", self.length), ("AccessMode", "RO"), ("pPort", f"{self.name}Port"))
        cached, order = ("Cachable", "NoCache"), ("Endianess", "LittleEndian")
        if self.real:
            value = xml.node("FloatReg", self.feature, *place, cached, order, ("Unit", self.unit))
        else:
            value = xml.node("IntReg", self.feature, *place, cached, ("Sign", "Unsigned"), order)
        return value + xml.node("Port", f"{self.name}Port", ("ChunkID", f"{self.id:08X}"))


CHUNKS = (
    Chunk("Image", _IMAGE_ID),
    Chunk("ExposureTime", 0x0000_A001, "ChunkExposureTime", unit="us", real=True),
    Chunk("Gain", 0x0000_A002, "ChunkGain", unit="dB", real=True),
    Chunk("Timestamp", 0x0000_A003, "ChunkTimestamp"),
    Chunk("FrameID", 0x0000_A004, "ChunkFrameID"),
)


@dataclass(frozen=True)
class ChunkValues:
    """What the chunks of one frame say."""

    exposure_us: float
    gain_db: float
    timestamp_ns: int
    frame_id: int

    def of(self, chunk: Chunk) -> bytes:
        """One chunk's value."""
        match chunk.name:
            case "ExposureTime":
                return struct.pack("<d", self.exposure_us)
            case "Gain":
                return struct.pack("<d", self.gain_db)
            case "Timestamp":
                return struct.pack("<Q", self.timestamp_ns)
            case _:
                return struct.pack("<Q", self.frame_id)


def appended(image: bytes, enabled: tuple[Chunk, ...], values: ChunkValues) -> bytes:
    """The payload of a frame in chunk mode: the image and the enabled chunks, each followed by its id and length."""
    parts = [_closed(_IMAGE_ID, image)]
    parts += [_closed(chunk.id, values.of(chunk)) for chunk in enabled if chunk.feature]
    return b"".join(parts)


def overhead(image_size: int, enabled: tuple[Chunk, ...]) -> int:
    """How many bytes ``appended`` adds to an image."""
    return _padding(image_size) + 8 + sum(chunk.length + 8 for chunk in enabled if chunk.feature)


def _closed(identifier: int, data: bytes) -> bytes:
    padding = _padding(len(data))
    return data + b"\0" * padding + struct.pack("<II", identifier, len(data) + padding)


def _padding(length: int) -> int:
    return -length % _ALIGNMENT
