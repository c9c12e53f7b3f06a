"""A host that knows only bytes: GenCP packets and stream reads made by hand on pyusb, to question a device with."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import final

import usb.core

from tests.virtual_u3v import registers as at
from tests.virtual_u3v.registers import Register

CONTROL_OUT, CONTROL_IN, STREAM_IN = 0x01, 0x81, 0x83
TIMEOUT_MS = 1000
_PREFIX, _READMEM, _WRITEMEM = 0x4356_3355, 0x0800, 0x0802
_TRANSFER = 1 << 20


@dataclass(frozen=True)
class Ack:
    """An acknowledge taken apart."""

    prefix: int
    status: int
    command: int
    request_id: int
    data: bytes


@dataclass(frozen=True)
class Sizes:
    """Transfer sizes agreed on with the device, in bytes."""

    leader: int
    payload: tuple[int, ...]
    trailer: int


@dataclass(frozen=True)
class RawFrame:
    """What came for one frame."""

    leader: bytes
    payload: bytes
    trailer: bytes

    @property
    def block_ids(self) -> tuple[int, int]:
        """As the leader and the trailer say."""
        return struct.unpack_from("<Q", self.leader, 8)[0], struct.unpack_from("<Q", self.trailer, 8)[0]

    @property
    def timestamp_ns(self) -> int:
        """As the leader says."""
        return struct.unpack_from("<Q", self.leader, 20)[0]

    @property
    def status(self) -> int:
        """As the trailer says."""
        return struct.unpack_from("<H", self.trailer, 16)[0]

    @property
    def valid_payload_size(self) -> int:
        """As the trailer says."""
        return struct.unpack_from("<Q", self.trailer, 20)[0]


@final
class RawHost:
    """Questions a device, and takes frames from it."""

    def __init__(self, device: usb.core.Device) -> None:
        self.device = device
        self._request_id = 0

    def ask(self, command: int, body: bytes) -> Ack:
        """Send a command and take the first acknowledge that comes."""
        self.send(command, body)
        return self.acknowledge()

    def send(self, command: int, body: bytes, *, flags: int = 0x4000, length: int | None = None) -> None:
        """Send a command."""
        self._request_id = self._request_id % 0xFFFF + 1
        size = len(body) if length is None else length
        head = struct.pack("<IHHHH", _PREFIX, flags, command, size, self._request_id)
        self.device.write(CONTROL_OUT, head + body, TIMEOUT_MS)

    def acknowledge(self, timeout_ms: int = TIMEOUT_MS) -> Ack:
        """Take an acknowledge."""
        packet = bytes(self.device.read(CONTROL_IN, 1024, timeout_ms))
        prefix, status, command, length, request_id = struct.unpack_from("<IHHHH", packet)
        if length != len(packet) - 12:
            raise ValueError(f"expected an acknowledge of {length} bytes, found {len(packet) - 12}")
        return Ack(prefix, status, command, request_id, packet[12:])

    def readmem(self, address: int, length: int) -> Ack:
        """READMEM."""
        return self.ask(_READMEM, struct.pack("<QHH", address, 0, length))

    def writemem(self, address: int, data: bytes) -> Ack:
        """WRITEMEM."""
        return self.ask(_WRITEMEM, struct.pack("<Q", address) + data)

    def get(self, register: Register) -> int:
        """A register's value; ValueError when the device refuses."""
        ack = self.readmem(register.address, register.length)
        if ack.status:
            raise ValueError(f"expected register 0x{register.address:x} to be read, found status 0x{ack.status:04x}")
        return int.from_bytes(ack.data, "little")

    def set(self, register: Register, value: int) -> int:
        """Write a register; the acknowledge's status."""
        return self.writemem(register.address, value.to_bytes(register.length, "little")).status

    def start(self, transfer: int = _TRANSFER) -> Sizes:
        """Agree on transfers of ``transfer`` bytes, switch the stream on and start; ValueError when refused."""
        alignment = 1 << (self.get(at.SI_INFO) >> 24)
        required = self.get(at.SI_REQUIRED_PAYLOAD_SIZE)
        count, rest = divmod(required, transfer)
        sizes = (-(-rest // alignment) * alignment, alignment, alignment)
        written = (sizes[1], transfer, count, sizes[0], 0, sizes[2])
        statuses = [
            self.writemem(at.SI_MAXIMUM_LEADER_SIZE.address, struct.pack("<6I", *written)).status,
            self.set(at.SI_CONTROL, 1),
            self.set(at.ACQUISITION_START, 1),
        ]
        if any(statuses):
            raise ValueError(f"expected the stream to start, found statuses {[hex(s) for s in statuses]}")
        return Sizes(sizes[1], (transfer,) * count + ((sizes[0],) if sizes[0] else ()), sizes[2])

    def stop(self) -> None:
        """Stop and switch the stream off."""
        if self.set(at.ACQUISITION_STOP, 1) or self.set(at.SI_CONTROL, 0):
            raise ValueError("expected the stream to stop, found it refused")

    def frame(self, sizes: Sizes, timeout_ms: int = TIMEOUT_MS) -> RawFrame:
        """Take one frame, reading exactly the transfers agreed on."""
        leader = bytes(self.device.read(STREAM_IN, sizes.leader, timeout_ms))
        parts = [bytes(self.device.read(STREAM_IN, size, timeout_ms)) for size in sizes.payload]
        return RawFrame(leader, b"".join(parts), bytes(self.device.read(STREAM_IN, sizes.trailer, timeout_ms)))
