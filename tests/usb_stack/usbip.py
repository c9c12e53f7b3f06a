"""Messages of USB/IP between Linux's vhci_hcd and a device (Linux Documentation/usb/usbip_protocol.rst), big endian."""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass
from typing import final

HEADER_SIZE = 48
_LONGEST_TRANSFER = 1 << 26


class Command(enum.IntEnum):
    """Kinds of messages."""

    CMD_SUBMIT = 1
    CMD_UNLINK = 2
    RET_SUBMIT = 3
    RET_UNLINK = 4


@final
class BadMessage(Exception):
    """The host sent something that is no USB/IP."""


@dataclass(frozen=True)
class Submit:
    """A transfer that the host wants done.

    Attributes:
        inward: whether data goes to the host.
        length: of the transfer's buffer, bytes.
        setup: 8 bytes, of use on endpoint 0.
    """

    sequence: int
    endpoint: int
    inward: bool
    length: int
    setup: bytes

    @property
    def address(self) -> int:
        """The endpoint's address, with the direction bit."""
        return self.endpoint | (0x80 if self.inward else 0)


@dataclass(frozen=True)
class Unlink:
    """A transfer that the host does not want any more."""

    sequence: int
    unwanted: int


def parse(header: bytes) -> Submit | Unlink:
    """A message of the host; BadMessage when it is none."""
    command, sequence, _, direction, endpoint = struct.unpack_from(">5I", header)
    if command == Command.CMD_UNLINK:
        return Unlink(sequence, struct.unpack_from(">I", header, 20)[0])
    if command != Command.CMD_SUBMIT:
        raise BadMessage(f"expected a submit or an unlink, found command {command}")
    _, length = struct.unpack_from(">Ii", header, 20)
    if not 0 <= length <= _LONGEST_TRANSFER or endpoint > 15:
        raise BadMessage(f"expected a transfer that can be, found {length} bytes on endpoint {endpoint}")
    return Submit(sequence, endpoint, direction == 1, length, header[40:48])


def submitted(submit: Submit, status: int, actual: int) -> bytes:
    """The header that answers a transfer; inward data follows it."""
    head = struct.pack(">5I", Command.RET_SUBMIT, submit.sequence, 0, 0, 0)
    return head + struct.pack(">5i8x", status, actual, 0, 0, 0)


def unlinked(unlink: Unlink, status: int) -> bytes:
    """The answer to an unlink: -ECONNRESET when the transfer was stopped, 0 when it had been done already."""
    return struct.pack(">5I", Command.RET_UNLINK, unlink.sequence, 0, 0, 0) + struct.pack(">i24x", status)
