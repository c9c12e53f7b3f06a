"""Reads frames from the stream endpoint: leader, payload and trailer; resynchronises after anything else."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol, final, runtime_checkable

from udccal.cameras.u3v.layout import StreamLayout
from udccal.cameras.u3v.stream import Leader, Trailer, is_leader, is_trailer, parse_leader, parse_trailer
from udccal.cameras.u3v.usb_errors import RECOVERABLE
from udccal.errors import CameraProtocolError, CameraTimeout

# The wait for a leader is cut into pieces, so that it can be stopped between them.
_SLICE_S: Final = 0.1
# How often the search for one frame may restart after a halt, an overflow, a failed transfer or repeated ids.
_MOST_TROUBLES: Final = 32


@runtime_checkable
class StreamLink(Protocol):
    """The stream endpoint; methods raise the errors of ``transport``."""

    def read_stream(self, buffer: array[int], timeout_s: float) -> int:
        """Fill a buffer with as many bytes as come."""
        ...

    def clear_stream_halt(self) -> None:
        """Make the endpoint usable again."""
        ...


@final
@dataclass(frozen=True)
class Block:
    """The received parts of one frame.

    Attributes:
        trailer: None when none came.
        received: bytes of payload, from its beginning without a gap.
    """

    leader: Leader
    trailer: Trailer | None
    received: int

    @property
    def valid(self) -> int:
        """Bytes of payload that came and are valid."""
        return self.received if self.trailer is None else min(self.received, self.trailer.valid_bytes)

    @property
    def whole(self) -> bool:
        """Whether the device reports that it sent everything, and all of it came."""
        trailer = self.trailer
        return (
            trailer is not None
            and trailer.block_id == self.leader.block_id
            and trailer.status == 0
            and trailer.valid_bytes <= self.received
        )


@final
class Receiver:
    """Reads one block after the other, each id once; discards data that belong to none.

    Args:
        timeout_s: limit of each transfer within a frame.
    """

    def __init__(self, link: StreamLink, layout: StreamLayout, timeout_s: float) -> None:
        self._link = link
        self._layout = layout
        self._timeout_s = timeout_s
        sizes = {layout.leader, layout.trailer, layout.transfer, *layout.transfers}
        self._buffers = {size: array("B", bytes(size)) for size in sizes}
        self._in_step = True
        self._next_leader: Leader | None = None
        self._last_id = -1

    @property
    def room(self) -> int:
        """Bytes that a buffer for a payload must have."""
        return sum(self._layout.transfers)

    def receive(self, payload: memoryview, wait_s: float, stopped: Callable[[], bool]) -> Block | None:
        """Return the next block, complete or not; fill ``payload`` from its beginning.

        Args:
            payload: buffer of ``room`` bytes.
            wait_s: longest wait for the leader.
            stopped: polled during the wait; the method returns None once it is true.

        Raises:
            CameraTimeout: when no leader comes.
            CameraLost: when the camera is gone.
            CameraProtocolError: when only data without leaders come, or only blocks with repeated ids.
        """
        for _ in range(_MOST_TROUBLES):
            leader = self._leader(wait_s, stopped)
            if leader is None:
                return None
            block = self._block(leader, payload)
            # A leader that is followed at once by another one was left over from an earlier run.
            left_over = not block.received and self._next_leader is not None
            if leader.block_id > self._last_id and not left_over:
                self._last_id = leader.block_id
                return block
        raise CameraProtocolError(
            f"Expected a frame after frame {self._last_id}, found {_MOST_TROUBLES} with repeated ids. "
            "Open the camera again."
        )

    def _leader(self, wait_s: float, stopped: Callable[[], bool]) -> Leader | None:
        """Return the next leader; None when stopped."""
        leader, self._next_leader = self._next_leader, None
        waited_s, foreign, troubles, unusable = 0.0, 0, 0, b""
        latest = time.monotonic() + wait_s + self._timeout_s
        while leader is None and not stopped():
            try:
                # After an error, long reads skip the rest of a broken frame; a leader ends one by its short packet.
                packet = self._read(self._layout.leader if self._in_step else self._layout.transfer, _SLICE_S)
                leader = _leader_in(packet)
            except CameraTimeout as error:
                waited_s += _SLICE_S
                if waited_s >= wait_s:
                    raise CameraTimeout(
                        f"Expected a frame within {wait_s:g} s, found none. Check the trigger, the cable and the port."
                    ) from error
                continue
            except RECOVERABLE:
                self._recover()
                packet, troubles = memoryview(b""), troubles + 1
            if leader is None:
                self._in_step, foreign = False, foreign + len(packet)
                unusable = bytes(packet) if is_leader(bytes(packet[:4])) else unusable
                if troubles > _MOST_TROUBLES or foreign > 4 * self.room or time.monotonic() > latest:
                    raise _no_leader(foreign, troubles, unusable)
        self._in_step = True
        return leader

    def _block(self, leader: Leader, payload: memoryview) -> Block:
        """Read what follows a leader until an error; the rest is discarded later."""
        received = 0
        try:
            for size in self._layout.transfers:
                data = self._read(size, self._timeout_s)
                if len(data) <= max(self._layout.leader, self._layout.trailer) and _is_head(data):
                    return self._ended(leader, received, data)
                payload[received : received + len(data)] = data
                received += len(data)
                if len(data) < size:  # the device has no more to send, or the time ran out
                    break
            data = self._read(self._layout.trailer, self._timeout_s)
            # Some devices end a payload with an empty packet even if it fills its transfers.
            return self._ended(leader, received, data or self._read(self._layout.trailer, self._timeout_s))
        except CameraTimeout:
            self._in_step = False
        except RECOVERABLE:
            self._recover()
        return Block(leader, None, received)

    def _ended(self, leader: Leader, received: int, packet: memoryview) -> Block:
        """Return the block with what came after its payload."""
        try:
            if is_trailer(bytes(packet[:4])):
                return Block(leader, parse_trailer(bytes(packet)), received)
        except CameraProtocolError:
            pass  # an incomplete trailer has no information about the payload
        self._next_leader = _leader_in(packet)
        self._in_step = self._next_leader is not None
        return Block(leader, None, received)

    def _recover(self) -> None:
        """Make the endpoint usable after a halt, an overflow or a failed transfer, and search for the next leader."""
        self._link.clear_stream_halt()
        self._in_step = False

    def _read(self, size: int, timeout_s: float) -> memoryview:
        buffer = self._buffers[size]
        return memoryview(buffer)[: self._link.read_stream(buffer, timeout_s)]


def _is_head(packet: memoryview) -> bool:
    start = bytes(packet[:4])
    return is_leader(start) or is_trailer(start)


def _leader_in(packet: memoryview) -> Leader | None:
    """Return the leader in a packet; None when it is something else, or an invalid leader."""
    try:
        return parse_leader(bytes(packet)) if is_leader(bytes(packet[:4])) else None
    except CameraProtocolError:
        return None


def _no_leader(foreign: int, troubles: int, unusable: bytes) -> CameraProtocolError:
    """Return why there is no frame: what is wrong with the last leader, where one came."""
    if unusable:
        try:
            parse_leader(unusable)
        except CameraProtocolError as error:
            return error
    return CameraProtocolError(
        f"Expected the leader of a frame, found {foreign} bytes of other data and {troubles} failed transfers. "
        "Unplug the camera and plug it in again."
    )
