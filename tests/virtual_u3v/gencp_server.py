"""The device's side of GenCP 1.x §4 over USB3 Vision: commands in, acknowledges out."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

from tests.virtual_u3v.memory import Refused, Status

PREFIX = 0x4356_3355  # "U3VC"
READMEM, WRITEMEM, PENDING_ACK = 0x0800, 0x0802, 0x0805
HEADER = struct.Struct("<IHHHH")
_ACKNOWLEDGE_WANTED = 0x4000


@dataclass(frozen=True)
class Acknowledge:
    """An acknowledge before it becomes bytes."""

    status: int
    command: int
    request_id: int
    data: bytes = b""
    prefix: int = PREFIX

    def to_bytes(self) -> bytes:
        """As on the wire."""
        return HEADER.pack(self.prefix, self.status, self.command, len(self.data), self.request_id) + self.data


@final
class GenCpServer:
    """Carries out READMEM and WRITEMEM.

    Args:
        read: (address, length) -> bytes.
        write: (address, data).
        max_transfer: longest command and acknowledge, bytes.
    """

    def __init__(
        self, read: Callable[[int, int], bytes], write: Callable[[int, bytes], None], max_transfer: int
    ) -> None:
        self._read = read
        self._write = write
        self._max_transfer = max_transfer

    def handle(self, packet: bytes) -> Acknowledge | None:
        """The acknowledge of a command; None where none is due: no GenCP command, or none wanted."""
        if len(packet) < HEADER.size:
            return None
        prefix, flags, command, length, request_id = HEADER.unpack_from(packet)
        if prefix != PREFIX:
            return None
        body = packet[HEADER.size :]
        try:
            if length != len(body) or len(packet) > self._max_transfer:
                raise Refused(Status.INVALID_HEADER)
            status, data = Status.SUCCESS, self._carry_out(command, body)
        except Refused as refusal:
            status, data = refusal.status, b""
        wanted = flags & _ACKNOWLEDGE_WANTED
        return Acknowledge(status, command + 1, request_id, data) if wanted else None

    def refuse(self, packet: bytes, status: int) -> Acknowledge:
        """The acknowledge that says no to a command without looking at it."""
        _, _, command, _, request_id = HEADER.unpack_from(packet.ljust(HEADER.size, b"\0"))
        return Acknowledge(status, command + 1, request_id)

    def _carry_out(self, command: int, body: bytes) -> bytes:
        if command == READMEM and len(body) == 12:
            address, _, length = struct.unpack("<QHH", body)
            if HEADER.size + length > self._max_transfer:
                raise Refused(Status.INVALID_PARAMETER)
            return self._read(address, length)
        if command == WRITEMEM and len(body) > 8:
            self._write(int.from_bytes(body[:8], "little"), body[8:])
            return struct.pack("<HH", 0, len(body) - 8)
        raise Refused(Status.INVALID_HEADER if command in (READMEM, WRITEMEM) else Status.NOT_IMPLEMENTED)
