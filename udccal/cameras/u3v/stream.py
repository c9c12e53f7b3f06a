"""Decodes the leader and trailer of a payload (USB3 Vision, stream protocol)."""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass
from typing import Final, final

from udccal.errors import CameraProtocolError

_LEADER: Final = b"U3VL"
_TRAILER: Final = b"U3VT"
# Magic, reserved, size, block id; then of a leader: reserved, payload type, timestamp.
_LEADER_HEAD: Final = struct.Struct("<4sHHQHHQ")
# Pixel format, columns, rows, x, y, padding after each line, reserved.
_IMAGE: Final = struct.Struct("<IIIIIHH")
# Magic, reserved, size, block id, status, reserved, valid bytes of payload.
_TRAILER_HEAD: Final = struct.Struct("<4sHHQHHQ")
_ROWS: Final = struct.Struct("<I")

IMAGE_LEADER_BYTES: Final = _LEADER_HEAD.size + _IMAGE.size
IMAGE_TRAILER_BYTES: Final = _TRAILER_HEAD.size + _ROWS.size


@final
class PayloadType(enum.IntEnum):
    """Kind of the payload."""

    IMAGE = 0x0001
    CHUNK = 0x4000
    IMAGE_EXTENDED_CHUNK = 0x4001


@final
@dataclass(frozen=True)
class ImageInfo:
    """The picture that a leader announces; ``pixel_format`` is PFNC's code, ``padding_x`` bytes after each line."""

    pixel_format: int
    columns: int
    rows: int
    x: int
    y: int
    padding_x: int


@final
@dataclass(frozen=True)
class Leader:
    """The packet before a payload; ``image`` is None where the payload is chunks alone."""

    block_id: int
    payload_type: PayloadType
    timestamp_ns: int
    image: ImageInfo | None


@final
@dataclass(frozen=True)
class Trailer:
    """The packet after a payload.

    Attributes:
        status: 0 when the device sent everything; 0xA100 when it discarded data, 0xA101 after an overrun.
        valid_bytes: valid bytes of the payload; the rest is padding.
        rows: true number of rows of the picture; None where the payload is chunks alone.
    """

    block_id: int
    status: int
    valid_bytes: int
    rows: int | None


def is_leader(packet: bytes) -> bool:
    """Return whether a packet starts as a leader does."""
    return packet.startswith(_LEADER)


def is_trailer(packet: bytes) -> bool:
    """Return whether a packet starts as a trailer does."""
    return packet.startswith(_TRAILER)


def parse_leader(packet: bytes) -> Leader:
    """Decode a leader from the bytes of one transfer.

    Raises:
        CameraProtocolError: when it is not a leader, is incomplete, or announces a payload of an unknown kind.
    """
    _check("leader", packet, is_leader(packet), _LEADER_HEAD.size)
    _, _, _, block_id, _, kind, timestamp_ns = _LEADER_HEAD.unpack_from(packet)
    if kind not in set(PayloadType):
        raise CameraProtocolError(
            f"Expected a payload of an image, chunks or both, found type {kind:#06x}. Choose an uncompressed "
            "PixelFormat, and switch multi-part and GenDC streaming off."
        )
    payload_type = PayloadType(kind)
    if payload_type is PayloadType.CHUNK:
        return Leader(block_id, payload_type, timestamp_ns, None)
    _check("leader", packet, True, IMAGE_LEADER_BYTES)
    fields = _IMAGE.unpack_from(packet, _LEADER_HEAD.size)
    return Leader(block_id, payload_type, timestamp_ns, ImageInfo(*fields[:6]))


def parse_trailer(packet: bytes) -> Trailer:
    """Decode a trailer from the bytes of one transfer.

    Raises:
        CameraProtocolError: when it is not a trailer or is incomplete.
    """
    _check("trailer", packet, is_trailer(packet), _TRAILER_HEAD.size)
    _, _, _, block_id, status, _, valid_bytes = _TRAILER_HEAD.unpack_from(packet)
    rows = _ROWS.unpack_from(packet, _TRAILER_HEAD.size)[0] if len(packet) >= IMAGE_TRAILER_BYTES else None
    return Trailer(block_id, status, valid_bytes, rows)


def _check(what: str, packet: bytes, starts: bool, needed: int) -> None:
    """Refuse a packet with a wrong start, or shorter than required or than its own size field."""
    said = struct.unpack_from("<H", packet, 6)[0] if len(packet) >= 8 else 0
    if not starts or len(packet) < max(needed, said) or said < needed:
        raise CameraProtocolError(
            f"Expected a {what} of {needed} bytes, found {len(packet)} starting with {packet[:4]!r}, declaring {said}. "
            "Check the cable; if that does not help, update the camera's firmware."
        )
