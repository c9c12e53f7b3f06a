"""Registers that every camera has at the same addresses: its identity, the other registers, and its limits."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final, final

from udccal.cameras.u3v.control import ControlChannel
from udccal.errors import CameraProtocolError

# Technology Agnostic Bootstrap Register Map, ABRM (GenICam GenCP): addresses.
_MANUFACTURER_NAME: Final = 0x0004
_MODEL_NAME: Final = 0x0044
_SERIAL_NUMBER: Final = 0x0144
_MAXIMUM_DEVICE_RESPONSE_TIME: Final = 0x01CC
_MANIFEST_TABLE_ADDRESS: Final = 0x01D0
_SBRM_ADDRESS: Final = 0x01D8
_STRING_BYTES: Final = 64

# Technology Specific Bootstrap Register Map, SBRM (USB3 Vision): offsets.
_U3VCP_CAPABILITY: Final = 0x04
_MAXIMUM_TRANSFER_LENGTHS: Final = 0x14  # lengths of a command, then of an acknowledge
_SIRM_ADDRESS: Final = 0x20
_SIRM_AVAILABLE: Final = 1


@final
@dataclass(frozen=True)
class Bootstrap:
    """A camera's bootstrap data, known before its description is read.

    Attributes:
        manifest_address: address of the table that locates its description.
        sirm_address: address of the registers of its streaming interface.
    """

    vendor: str
    model: str
    serial: str
    manifest_address: int
    sirm_address: int


def read_bootstrap(control: ControlChannel) -> Bootstrap:
    """Read the registers, and apply their limits to the channel.

    Raises:
        CameraProtocolError: when it has no streaming interface, or the registers are invalid.
        CameraTimeout, CameraLost, CameraError: as for ``ControlChannel.read``.
    """
    response_ms = _uint32(control, _MAXIMUM_DEVICE_RESPONSE_TIME)
    manifest = _uint64(control, _MANIFEST_TABLE_ADDRESS)
    sbrm = _uint64(control, _SBRM_ADDRESS)
    command_bytes = _uint32(control, sbrm + _MAXIMUM_TRANSFER_LENGTHS)
    acknowledge_bytes = _uint32(control, sbrm + _MAXIMUM_TRANSFER_LENGTHS + 4)
    control.limit(1e-3 * response_ms, command_bytes, acknowledge_bytes)
    # Texts are longer than the shortest messages.
    vendor, model, serial = (_text(control, a) for a in (_MANUFACTURER_NAME, _MODEL_NAME, _SERIAL_NUMBER))
    if not _uint64(control, sbrm + _U3VCP_CAPABILITY) & _SIRM_AVAILABLE:
        raise CameraProtocolError(
            f"Expected a camera with a streaming interface, found that {model} {serial} has none. Use another camera."
        )
    return Bootstrap(vendor, model, serial, manifest, _uint64(control, sbrm + _SIRM_ADDRESS))


def _uint32(control: ControlChannel, address: int) -> int:
    return int(struct.unpack("<I", control.read(address, 4))[0])


def _uint64(control: ControlChannel, address: int) -> int:
    return int(struct.unpack("<Q", control.read(address, 8))[0])


def _text(control: ControlChannel, address: int) -> str:
    """Return a string register: UTF-8 or ASCII, ended by a zero or by the register's end."""
    raw = control.read(address, _STRING_BYTES).split(b"\0")[0]
    return "".join(c for c in raw.decode("utf-8", "replace") if c.isprintable()).strip()
