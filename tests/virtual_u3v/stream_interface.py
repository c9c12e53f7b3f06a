"""The streaming interface's registers (USB3 Vision 1.0 §5.4): transfer sizes, and the switch that checks them."""

from __future__ import annotations

from collections.abc import Callable
from typing import final

from tests.virtual_u3v import registers as at
from tests.virtual_u3v.features import Rule
from tests.virtual_u3v.memory import Memory, Refused, Status
from tests.virtual_u3v.registers import Register
from tests.virtual_u3v.stream_protocol import LEADER_SIZE, TRAILER_SIZE

_SIZES = (
    at.SI_MAXIMUM_LEADER_SIZE,
    at.SI_PAYLOAD_TRANSFER_SIZE,
    at.SI_PAYLOAD_FINAL_TRANSFER1_SIZE,
    at.SI_PAYLOAD_FINAL_TRANSFER2_SIZE,
    at.SI_MAXIMUM_TRAILER_SIZE,
)


@final
class StreamInterface:
    """Whether the host listens to the stream, and with transfers of which sizes.

    Args:
        payload_size: of a frame with the present features.
        halted: says whether the stream endpoint is halted.
        switched: is called when the stream was switched on or off.
    """

    def __init__(
        self,
        memory: Memory,
        alignment: int,
        payload_size: Callable[[], int],
        halted: Callable[[], bool],
        switched: Callable[[], None],
    ) -> None:
        self._memory = memory
        self._alignment = alignment
        self._payload_size = payload_size
        self._halted = halted
        self._switched = switched

    @property
    def enabled(self) -> bool:
        """Whether the stream is on."""
        return bool(self._memory.uint(at.SI_CONTROL) & 1)

    @property
    def room(self) -> int:
        """Bytes that the host's payload transfers hold together."""
        sizes = (at.SI_PAYLOAD_FINAL_TRANSFER1_SIZE, at.SI_PAYLOAD_FINAL_TRANSFER2_SIZE)
        equal = self._memory.uint(at.SI_PAYLOAD_TRANSFER_SIZE) * self._memory.uint(at.SI_PAYLOAD_TRANSFER_COUNT)
        return equal + sum(self._memory.uint(size) for size in sizes)

    def rules(self) -> dict[Register, Rule]:
        """What happens when one of the registers is written."""
        rules: dict[Register, Rule] = dict.fromkeys(_SIZES, self._size)
        return rules | {at.SI_PAYLOAD_TRANSFER_COUNT: self._count, at.SI_CONTROL: self._switch}

    def _size(self, value: int) -> int:
        if value % self._alignment:
            raise Refused(Status.PAYLOAD_SIZE_NOT_ALIGNED)
        return self._count(value)

    def _count(self, value: int) -> int:
        if self.enabled:
            raise Refused(Status.ACCESS_DENIED)
        return value

    def _switch(self, value: int) -> int:
        if value & 1 and not self.enabled:
            if self._halted():
                raise Refused(Status.STREAM_ENDPOINT_HALTED)
            leader, trailer = (
                self._memory.uint(size) for size in (at.SI_MAXIMUM_LEADER_SIZE, at.SI_MAXIMUM_TRAILER_SIZE)
            )
            if leader < LEADER_SIZE or trailer < TRAILER_SIZE or self.room < self._payload_size():
                raise Refused(Status.STREAM_REGISTERS_INCONSISTENT)
        self._switched()
        return value & 1
