"""The camera's memory: registers and read-only files, reached by address."""

from __future__ import annotations

import enum
from bisect import bisect_right
from typing import final

from tests.virtual_u3v.registers import EVERY_REGISTER, Access, Register

# What a bootstrap map does not define reads as zero up to here, as on real cameras.
_PAGE = 0x1000


class Status(enum.IntEnum):
    """Status codes of acknowledges: GenCP 1.x §4.3.1 (0x8...) and USB3 Vision 1.0 §5.4 (0xA...)."""

    SUCCESS = 0x0000
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    INVALID_HEADER = 0x800E
    ERROR = 0x8FFF
    STREAM_ENDPOINT_HALTED = 0xA002
    PAYLOAD_SIZE_NOT_ALIGNED = 0xA003
    STREAM_REGISTERS_INCONSISTENT = 0xA004
    DATA_DISCARDED = 0xA100


@final
class Refused(Exception):
    """The camera does not do what was asked; ``status`` goes into the acknowledge."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.name)
        self.status = status


@final
class Memory:
    """Bytes by address: pages that hold the registers, and files."""

    def __init__(self, files: tuple[tuple[int, bytes], ...]) -> None:
        bases = sorted({register.address - register.address % _PAGE for register in EVERY_REGISTER})
        areas = [(base, bytearray(_PAGE)) for base in bases] + [(base, bytearray(data)) for base, data in files]
        self._areas = sorted(areas, key=lambda area: area[0])
        self._bases = [base for base, _ in self._areas]

    def read(self, address: int, length: int) -> bytes:
        """``length`` bytes from ``address`` on; Refused where nothing is mapped or a register cannot be read."""
        if any(register.access is Access.WO for register in touched(address, length)):
            raise Refused(Status.ACCESS_DENIED)
        area, start = self._locate(address, length)
        return bytes(area[start : start + length])

    def writable(self, address: int, length: int) -> tuple[Register, ...]:
        """The registers that a write of this range fills, each whole; Refused when it may not be written."""
        self._locate(address, length)
        registers = touched(address, length)
        if not registers or any(register.access is Access.RO for register in registers):
            raise Refused(Status.WRITE_PROTECT)
        whole = sum(register.length for register in registers) == length and registers[0].address == address
        if not whole:
            raise Refused(Status.BAD_ALIGNMENT)
        return registers

    def put(self, register: Register, data: bytes) -> None:
        """Set a register's bytes, whoever may write it; shorter data is filled up with zeros."""
        area, start = self._locate(register.address, register.length)
        area[start : start + register.length] = data.ljust(register.length, b"\0")

    def put_uint(self, register: Register, value: int) -> None:
        """Set a register's little-endian unsigned value."""
        self.put(register, value.to_bytes(register.length, "little"))

    def uint(self, register: Register) -> int:
        """A register's little-endian unsigned value."""
        area, start = self._locate(register.address, register.length)
        return int.from_bytes(area[start : start + register.length], "little")

    def _locate(self, address: int, length: int) -> tuple[bytearray, int]:
        index = bisect_right(self._bases, address) - 1
        if index >= 0:
            base, area = self._areas[index]
            if address + length <= base + len(area):
                return area, address - base
        raise Refused(Status.INVALID_ADDRESS)


def touched(address: int, length: int) -> tuple[Register, ...]:
    """The registers of which at least one byte lies in a range, by address."""
    return tuple(r for r in EVERY_REGISTER if r.address < address + length and address < r.address + r.length)
