"""GenCP over USB3 Vision: encodes commands and decodes acknowledges, without a device.

A message is a prefix ``U3VC``, a header of flags or status, command, length of what follows and request id, and the
command's own data; everything is little-endian (GenICam GenCP; prefix after USB3 Vision).
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass
from typing import Final, final

from udccal.errors import CameraError, CameraProtocolError

_PREFIX: Final = b"U3VC"
_REQUEST_ACKNOWLEDGE: Final = 0x4000
_HEADER: Final = struct.Struct("<4sHHHH")
_READ: Final = struct.Struct("<QHH")
_WRITE: Final = struct.Struct("<Q")
_TWO_WORDS: Final = struct.Struct("<HH")

HEADER_BYTES: Final = _HEADER.size
READ_COMMAND_BYTES: Final = _HEADER.size + _READ.size
WRITE_COMMAND_BYTES: Final = _HEADER.size + _WRITE.size
# Acknowledges of other commands than a read have at most this length.
SHORT_ACKNOWLEDGE_BYTES: Final = _HEADER.size + _TWO_WORDS.size


@final
class Command(enum.IntEnum):
    """Commands and acknowledges (GenCP, command ids)."""

    READMEM = 0x0800
    READMEM_ACK = 0x0801
    WRITEMEM = 0x0802
    WRITEMEM_ACK = 0x0803
    PENDING_ACK = 0x0805


@final
class Status(enum.IntEnum):
    """Status of an answer (GenCP, status codes; the 0xA000s are USB3 Vision's own)."""

    SUCCESS = 0x0000
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    MSG_TIMEOUT = 0x800B
    INVALID_HEADER = 0x800E
    WRONG_CONFIG = 0x800F
    GENERIC_ERROR = 0x8FFF
    RESEND_NOT_SUPPORTED = 0xA001
    STREAM_ENDPOINT_HALTED = 0xA002
    PAYLOAD_SIZE_NOT_ALIGNED = 0xA003
    STREAM_INTERFACE_INCONSISTENT = 0xA004
    EVENT_ENDPOINT_HALTED = 0xA005


_ADVICE: Final = {
    Status.WRITE_PROTECT: "The setting is locked, perhaps while frames are being taken: stop them first.",
    Status.ACCESS_DENIED: "Another program may control the camera: close it.",
    Status.BUSY: "Wait a moment and try again.",
    Status.MSG_TIMEOUT: "Unplug the camera and plug it in again.",
    Status.GENERIC_ERROR: "Unplug the camera and plug it in again; if that does not help, update its firmware.",
    Status.STREAM_ENDPOINT_HALTED: "Open the camera again.",
    Status.STREAM_INTERFACE_INCONSISTENT: "Open the camera again.",
}
_OTHER_ADVICE: Final = "The camera does not support what was asked; update its firmware or report its model."


@final
@dataclass(frozen=True)
class Acknowledge:
    """One acknowledge; ``status`` and ``command`` may be numbers that no standard defines."""

    status: int
    command: int
    request_id: int
    data: bytes


def encode_read(request_id: int, address: int, length: int) -> bytes:
    """Encode READMEM, which asks for ``length`` bytes, 65535 at most, from an address."""
    header = _HEADER.pack(_PREFIX, _REQUEST_ACKNOWLEDGE, Command.READMEM, _READ.size, request_id)
    return header + _READ.pack(address, 0, length)


def encode_write(request_id: int, address: int, data: bytes) -> bytes:
    """Encode WRITEMEM, which writes ``data``, 65527 bytes at most, to an address."""
    header = _HEADER.pack(_PREFIX, _REQUEST_ACKNOWLEDGE, Command.WRITEMEM, _WRITE.size + len(data), request_id)
    return header + _WRITE.pack(address) + data


def decode_acknowledge(packet: bytes) -> Acknowledge:
    """Decode a packet from the control endpoint.

    Raises:
        CameraProtocolError: when it is not a GenCP acknowledge, or its length differs from its header.
    """
    if len(packet) < _HEADER.size or not packet.startswith(_PREFIX):
        raise CameraProtocolError(
            f"Expected an acknowledge that starts with U3VC, found {len(packet)} bytes that start with "
            f"{packet[:4]!r}. Unplug the camera and plug it in again."
        )
    _, status, command, length, request_id = _HEADER.unpack_from(packet)
    if len(packet) != _HEADER.size + length:
        raise CameraProtocolError(
            f"Expected an acknowledge of {_HEADER.size + length} bytes as its header says, found {len(packet)}. "
            "Unplug the camera and plug it in again."
        )
    return Acknowledge(status, command, request_id, packet[_HEADER.size :])


def pending_s(acknowledge: Acknowledge) -> float:
    """Return how long a PENDING_ACK asks to wait, s.

    Raises:
        CameraProtocolError: when it does not contain the time.
    """
    if len(acknowledge.data) != _TWO_WORDS.size:
        raise CameraProtocolError(
            f"Expected 4 bytes in a PENDING_ACK, found {len(acknowledge.data)}. Update the camera's firmware."
        )
    return float(_TWO_WORDS.unpack(acknowledge.data)[1]) / 1e3


def written_bytes(acknowledge: Acknowledge) -> int | None:
    """Return the number of bytes written according to a WRITEMEM_ACK; None when the device does not give it.

    Raises:
        CameraProtocolError: when its data is neither empty nor two words.
    """
    if not acknowledge.data:
        return None
    if len(acknowledge.data) != _TWO_WORDS.size:
        raise CameraProtocolError(
            f"Expected 0 or 4 bytes in a WRITEMEM_ACK, found {len(acknowledge.data)}. Update the camera's firmware."
        )
    return int(_TWO_WORDS.unpack(acknowledge.data)[1])


def refusal(status: int, what: str) -> CameraError:
    """Return the error of a device that refused ``what``, with the status by name and what to do."""
    known = status in set(Status)
    name = Status(status).name if known else "unknown"
    advice = _ADVICE.get(Status(status), _OTHER_ADVICE) if known else _OTHER_ADVICE
    return CameraError(f"Expected the camera to accept {what}, found status {name} ({status:#06x}). {advice}")
