"""What waits in the device behind one bulk IN endpoint, given out packet by packet as the bus does."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import final

from tests.virtual_u3v.usb_faults import Overflowed, Stalled, Unplugged


@dataclass(frozen=True)
class Message:
    """Bytes that the device sends.

    Attributes:
        closed: whether the host's transfer ends behind it in any case, with an empty packet where need be. Without it,
            a message of whole packets runs on into the next one, unless the host's transfer is full.
        ready_ns: when the first packet can go.
        fault: what happens in its place.
    """

    data: bytes
    closed: bool = True
    ready_ns: int = 0
    fault: type[Stalled] | type[Overflowed] | type[Unplugged] | None = None


@final
class BulkIn:
    """A queue of messages behind an endpoint with packets of ``packet_size`` bytes."""

    def __init__(self, packet_size: int) -> None:
        self._packet_size = packet_size
        self._waiting: deque[Message] = deque()
        self._sent = 0  # bytes of the first message

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        return not self._waiting

    def push(self, message: Message) -> None:
        """Put a message at the end."""
        self._waiting.append(message)

    def clear(self) -> None:
        """Forget everything that waits."""
        self._waiting.clear()
        self._sent = 0

    def ready_ns(self) -> int | None:
        """When the first message can go; None when there is none."""
        return self._waiting[0].ready_ns if self._waiting else None

    def read(self, length: int, now_ns: int) -> bytes | memoryview | None:
        """What a transfer of ``length`` bytes receives; None when the device has nothing yet (NAK).

        Raises:
            Overflowed: a packet does not fit into what is left of the transfer.
            Stalled, Unplugged: as ordered.
        """
        parts: list[memoryview] = []
        room = length
        while self._waiting and self._waiting[0].ready_ns <= now_ns:
            message = self._waiting[0]
            if message.fault is not None:
                self._drop_first()
                raise message.fault("as ordered")
            part = memoryview(message.data)[self._sent : self._sent + room]
            parts.append(part)
            room -= len(part)
            self._sent += len(part)
            if self._sent < len(message.data):
                self._refuse_cut_packet(length)
                break
            self._drop_first()
            if room == 0 or message.closed or len(message.data) % self._packet_size:
                break
        if len(parts) == 1:
            return parts[0]  # large, and not worth a copy
        return b"".join(parts) if parts else None

    def _refuse_cut_packet(self, length: int) -> None:
        if length % self._packet_size:
            self._drop_first()
            raise Overflowed("a packet was longer than the rest of the transfer")

    def _drop_first(self) -> None:
        self._waiting.popleft()
        self._sent = 0
