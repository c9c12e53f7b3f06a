"""Reads and writes a camera's registers through GenCP, with retries and bounded waits."""

from __future__ import annotations

import time
from typing import Final, Protocol, final, runtime_checkable

from udccal.cameras.u3v import gencp
from udccal.cameras.u3v.gencp import Acknowledge, Command, Status
from udccal.cameras.u3v.usb_errors import RECOVERABLE
from udccal.errors import CameraError, CameraProtocolError, CameraTimeout

_ATTEMPTS: Final = 3
# Most acknowledges during one command that belong to another command or only ask for more time.
_MOST_STALE: Final = 64
_MOST_PENDING: Final = 100
_LONGEST_PENDING_S: Final = 15.0
_BUSY_PAUSE_S: Final = 0.02
# Bootstrap registers are read with this limit before the device has reported its own; every device supports it.
_FIRST_TRANSFER_BYTES: Final = 128
_MOST_TRANSFER_BYTES: Final = 1 << 16
_FIRST_RESPONSE_S: Final = 0.5
_SHORTEST_RESPONSE_S: Final = 0.1


@runtime_checkable
class ControlLink(Protocol):
    """The control endpoints; methods raise the errors of ``transport``."""

    @property
    def control_packet(self) -> int:
        """Bytes of a full packet."""
        ...

    def send(self, command: bytes, timeout_s: float) -> None:
        """Send a message."""
        ...

    def receive(self, length: int, timeout_s: float) -> bytes:
        """Receive a message."""
        ...

    def clear_control_halts(self) -> None:
        """Make the endpoints usable again."""
        ...


@final
class ControlChannel:
    """Reads and writes a device's memory, long ranges in pieces that the device supports.

    A command whose acknowledge does not come is sent again with its old request id, so that a device that remembers
    ids does not execute it twice. Acknowledges of earlier commands are skipped.

    Args:
        timeout_s: limit of the last attempt, and bound on the time that the device may ask for each attempt.
    """

    def __init__(self, link: ControlLink, timeout_s: float) -> None:
        self._link = link
        self._timeout_s = timeout_s
        self._request_id = 0
        self._response_s = _FIRST_RESPONSE_S
        self._most_command = self._most_acknowledge = _FIRST_TRANSFER_BYTES
        self._resent = 0

    @property
    def resent(self) -> int:
        """Number of commands that were sent again, and that the device may have executed twice."""
        return self._resent

    def limit(self, response_s: float, command_bytes: int, acknowledge_bytes: int) -> None:
        """Apply the device's own limits: its longest time to answer, and its longest messages.

        Raises:
            CameraProtocolError: when its messages are too short for any register.
        """
        shortest = gencp.READ_COMMAND_BYTES + 8
        if min(command_bytes, acknowledge_bytes) < shortest:
            raise CameraProtocolError(
                f"Expected a camera that supports messages of {shortest} bytes, found {command_bytes} and "
                f"{acknowledge_bytes}. Update its firmware."
            )
        self._response_s = max(min(response_s, self._timeout_s), _SHORTEST_RESPONSE_S)
        self._most_command = min(command_bytes, _MOST_TRANSFER_BYTES)
        self._most_acknowledge = min(acknowledge_bytes, _MOST_TRANSFER_BYTES)

    def read(self, address: int, length: int) -> bytes:
        """Read ``length`` bytes from an address.

        Raises:
            CameraTimeout: when no acknowledge comes.
            CameraLost: when the device is gone.
            CameraProtocolError: when the answer is not an acknowledge.
            CameraError: when the device refuses.
        """
        _check_address(address, length)
        # Whole words, as devices may require aligned access.
        most = (self._most_acknowledge - gencp.HEADER_BYTES) // 8 * 8
        return b"".join(
            self._read_piece(address + start, min(most, length - start)) for start in range(0, length, most)
        )

    def write(self, address: int, data: bytes) -> None:
        """Write ``data`` to an address.

        Raises:
            CameraTimeout, CameraLost, CameraProtocolError, CameraError: as for ``read``.
        """
        _check_address(address, len(data))
        most = (self._most_command - gencp.WRITE_COMMAND_BYTES) // 8 * 8
        for start in range(0, len(data), most):
            self._write_piece(address + start, data[start : start + most])

    def _read_piece(self, address: int, length: int) -> bytes:
        what = f"a read of {length} bytes at {address:#x}"
        request_id = self._next_id()
        packet = gencp.encode_read(request_id, address, length)
        data = self._execute(packet, request_id, Command.READMEM_ACK, what).data
        if len(data) != length:
            raise CameraProtocolError(
                f"Expected {length} bytes from {address:#x}, found {len(data)}. Update the camera's firmware."
            )
        return data

    def _write_piece(self, address: int, data: bytes) -> None:
        what = f"a write of {len(data)} bytes at {address:#x}"
        request_id = self._next_id()
        packet = gencp.encode_write(request_id, address, data)
        written = gencp.written_bytes(self._execute(packet, request_id, Command.WRITEMEM_ACK, what))
        if written is not None and written != len(data):
            raise CameraProtocolError(
                f"Expected {len(data)} bytes to be written at {address:#x}, found {written}. Update the firmware."
            )

    def _next_id(self) -> int:
        self._request_id = self._request_id % 0xFFFF + 1  # 0 is reserved for messages without an acknowledge
        return self._request_id

    def _execute(self, packet: bytes, request_id: int, expected: Command, what: str) -> Acknowledge:
        trouble: CameraError = CameraTimeout(what)
        for attempt in range(_ATTEMPTS):
            self._resent += attempt > 0
            wait_s = self._response_s if attempt < _ATTEMPTS - 1 else max(self._response_s, self._timeout_s)
            try:
                acknowledge = self._answer(packet, request_id, expected, what, wait_s)
            except (CameraTimeout, CameraProtocolError) as error:
                trouble = error
            except RECOVERABLE as error:
                trouble = error
                self._link.clear_control_halts()
            else:
                if acknowledge.status == Status.SUCCESS:
                    return acknowledge
                raise gencp.refusal(acknowledge.status, what)
        raise trouble

    def _answer(self, packet: bytes, request_id: int, expected: Command, what: str, wait_s: float) -> Acknowledge:
        """Send a command, again for as long as the device is busy, up to the time-out; return its acknowledge."""
        latest = time.monotonic() + self._timeout_s
        while True:
            self._link.send(packet, wait_s)
            acknowledge = self._acknowledge(request_id, expected, what, wait_s)
            if acknowledge.status != Status.BUSY or time.monotonic() >= latest:
                return acknowledge
            time.sleep(_BUSY_PAUSE_S)

    def _acknowledge(self, request_id: int, expected: Command, what: str, wait_s: float) -> Acknowledge:
        """Return the acknowledge of a request; skip those of others and those that ask for more time."""
        pending = stale = 0
        latest = time.monotonic() + wait_s + _LONGEST_PENDING_S
        while pending <= _MOST_PENDING and stale <= _MOST_STALE and time.monotonic() < latest:
            acknowledge = gencp.decode_acknowledge(self._link.receive(self._room(), wait_s))
            if acknowledge.request_id != request_id:
                stale += 1
            elif acknowledge.command == Command.PENDING_ACK:
                pending += 1
                asked_s = gencp.pending_s(acknowledge) + self._response_s
                wait_s = max(0.0, min(asked_s, latest - time.monotonic()))
            elif acknowledge.status == Status.SUCCESS and acknowledge.command != expected:
                raise CameraProtocolError(
                    f"Expected {expected.name} to {what}, found command {acknowledge.command:#06x}. "
                    "Unplug the camera and plug it in again."
                )
            else:
                return acknowledge
        raise CameraTimeout(
            f"Expected an acknowledge of {what}, found {stale} of other commands and {pending} that ask for more time. "
            "Unplug the camera and plug it in again."
        )

    def _room(self) -> int:
        """Return the length of a read from the control endpoint: whole packets, so that every acknowledge fits."""
        packet = max(1, self._link.control_packet)
        most = max(self._most_acknowledge, gencp.SHORT_ACKNOWLEDGE_BYTES)
        return -(-most // packet) * packet


def _check_address(address: int, length: int) -> None:
    if not 0 <= address <= (1 << 64) - length:
        raise CameraProtocolError(
            f"Expected {length} bytes at an address of 64 bits, found {address:#x}. Update the camera's firmware."
        )
