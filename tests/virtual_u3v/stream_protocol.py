"""Leader, payload and trailer of USB3 Vision 1.0 §5.5, with the faults that were ordered."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from tests.virtual_u3v.bulk_in import Message
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.memory import Status
from tests.virtual_u3v.usb_faults import Overflowed, Stalled, Unplugged

LEADER_SIZE, TRAILER_SIZE = 52, 36
_LEADER_MAGIC, _TRAILER_MAGIC = 0x4C56_3355, 0x5456_3355  # "U3VL", "U3VT"
_IMAGE, _IMAGE_EXTENDED_CHUNK = 0x0001, 0x4001
_SURPLUS = 4096


@dataclass(frozen=True)
class StreamFrame:
    """A frame ready to be sent.

    Attributes:
        code: PFNC code of its pixel format.
        payload: the image, and chunks behind it when ``chunked``.
        room: bytes that the host's payload transfers hold together.
    """

    block_id: int
    timestamp_ns: int
    code: int
    x: int
    y: int
    columns: int
    rows: int
    chunked: bool
    payload: bytes
    room: int

    def leader(self) -> bytes:
        """The image leader."""
        kind = _IMAGE_EXTENDED_CHUNK if self.chunked else _IMAGE
        head = (_LEADER_MAGIC, 0, LEADER_SIZE, self.block_id, 0, kind, self.timestamp_ns, self.code)
        return struct.pack("<IHHQHHQIIIIIHH", *head, self.columns, self.rows, self.x, self.y, 0, 0)

    def trailer(self, status: int, valid_payload_size: int, block_id: int) -> bytes:
        """The image trailer, with the id of the chunk layout behind it where there are chunks."""
        size = TRAILER_SIZE if self.chunked else TRAILER_SIZE - 4
        head = (_TRAILER_MAGIC, 0, size, block_id, status, 0, valid_payload_size, self.rows)
        layout = struct.pack("<I", 1) if self.chunked else b""
        return struct.pack("<IHHQHHQI", *head) + layout


def messages(frame: StreamFrame, number: int, faults: Faults, ready_ns: int) -> tuple[Message, ...]:
    """What the device sends for a frame, the ``number``-th since the faults were ordered."""
    if number in faults.dropped_frames:
        return ()
    sent = _payload(frame, number, faults)
    lies = number in faults.lying_frames
    status = Status.DATA_DISCARDED if number in faults.short_frames else Status.SUCCESS
    valid = len(frame.payload) if lies else len(sent)
    block_id = frame.block_id + 1000 if number in faults.wrong_block_ids else frame.block_id
    parts = [] if number in faults.missing_leaders else [Message(frame.leader(), ready_ns=ready_ns)]
    broken = _break(number, faults)
    if broken or number == faults.hang_at_frame:
        half = sent[: len(sent) // 2 // _SURPLUS * _SURPLUS]
        return (*parts, Message(half, closed=False, ready_ns=ready_ns), *broken)
    parts.append(Message(sent, closed=len(sent) < frame.room, ready_ns=ready_ns))
    if number not in faults.missing_trailers:
        parts.append(Message(frame.trailer(status, valid, block_id), ready_ns=ready_ns))
    return tuple(parts) * (2 if number in faults.duplicated_frames else 1)


def _payload(frame: StreamFrame, number: int, faults: Faults) -> bytes:
    if number in faults.short_frames or number in faults.lying_frames:
        return frame.payload[: len(frame.payload) // 2]
    return frame.payload + b"\xee" * _SURPLUS if number in faults.long_frames else frame.payload


def _break(number: int, faults: Faults) -> tuple[Message, ...]:
    """What ends a frame in the middle, with an error on the bus."""
    if number in faults.stream_halts:
        return (Message(b"", fault=Stalled),)
    if number in faults.babble_frames:
        return (Message(b"", fault=Overflowed),)
    if number == faults.unplug_at_frame:
        return (Message(b"", fault=Unplugged),)
    return ()
