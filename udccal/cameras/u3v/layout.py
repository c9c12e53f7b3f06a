"""Cuts a frame's payload into USB transfers, and agrees on them with the camera through its streaming registers."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final, final

from udccal.cameras.u3v.control import ControlChannel
from udccal.cameras.u3v.stream import IMAGE_LEADER_BYTES, IMAGE_TRAILER_BYTES
from udccal.errors import CameraProtocolError

# Reads of about this size: usbfs allows no transfer above 16 MiB, and small ones cost time.
_TRANSFER_BYTES: Final = 1 << 20
_MOST_PAYLOAD_BYTES: Final = 1 << 28
_MOST_HEAD_BYTES: Final = 1 << 16
_MOST_ALIGNMENT_BITS: Final = 20

# Streaming Interface Register Map, SIRM (USB3 Vision): offsets.
_INFO: Final = 0x00
_CONTROL: Final = 0x04
_REQUIRED: Final = 0x08  # sizes of payload (8 bytes), leader and trailer
_MAXIMUM_LEADER: Final = 0x18
_PAYLOAD: Final = 0x1C  # transfer size, transfer count, final transfer 1, final transfer 2
_MAXIMUM_TRAILER: Final = 0x2C
_ENABLE: Final = 1


@final
@dataclass(frozen=True)
class StreamLayout:
    """Lengths of the transfers that carry one frame, bytes.

    Attributes:
        leader, trailer: lengths of the transfers before and after the payload.
        payload: longest payload of a frame.
        transfer, count: length and number of the equal transfers with the payload's beginning.
        final1, final2: lengths of the transfers with the rest; 0 where there is none.
    """

    leader: int
    trailer: int
    payload: int
    transfer: int
    count: int
    final1: int
    final2: int

    @property
    def transfers(self) -> tuple[int, ...]:
        """Lengths of the payload's transfers in order."""
        return (self.transfer,) * self.count + tuple(size for size in (self.final1, self.final2) if size)


def plan_layout(payload: int, leader: int, trailer: int, alignment: int) -> StreamLayout:
    """Cut a payload into transfers that are whole multiples of ``alignment``, a power of two.

    Raises:
        CameraProtocolError: when a size is beyond any real camera's.
    """
    if not 0 < payload <= _MOST_PAYLOAD_BYTES or max(leader, trailer) > _MOST_HEAD_BYTES:
        raise CameraProtocolError(
            f"Expected a payload of up to {_MOST_PAYLOAD_BYTES} bytes between up to {_MOST_HEAD_BYTES}, found "
            f"{payload} between {leader} and {trailer}. Choose a smaller region."
        )
    transfer = max(_TRANSFER_BYTES, alignment)
    count, rest = divmod(payload, transfer)
    return StreamLayout(
        leader=_up(max(leader, IMAGE_LEADER_BYTES), alignment),
        trailer=_up(max(trailer, IMAGE_TRAILER_BYTES), alignment),
        payload=payload,
        transfer=transfer,
        count=count,
        final1=_up(rest, alignment),
        final2=0,
    )


@final
class StreamRegisters:
    """The registers of a camera's streaming interface."""

    def __init__(self, control: ControlChannel, address: int) -> None:
        self._control = control
        self._address = address

    def configure(self, packet_bytes: int) -> StreamLayout:
        """Agree on transfers for the current settings, with the stream switched off.

        Args:
            packet_bytes: length of a full USB packet; transfers are multiples of it too, so that no packet is cut.

        Raises:
            CameraProtocolError: when the camera's sizes are beyond any real camera's.
            CameraError: when it refuses.
        """
        bits = self._read(_INFO, "<I")[0] >> 24
        if bits > _MOST_ALIGNMENT_BITS:
            raise CameraProtocolError(
                f"Expected transfers aligned to up to 2**{_MOST_ALIGNMENT_BITS} bytes, found 2**{bits}. "
                "Update the camera's firmware."
            )
        payload, leader, trailer = self._read(_REQUIRED, "<QII")
        layout = plan_layout(payload, leader, trailer, max(1 << bits, packet_bytes))
        self._write(_MAXIMUM_LEADER, layout.leader)
        self._write(_MAXIMUM_TRAILER, layout.trailer)
        for i, value in enumerate((layout.transfer, layout.count, layout.final1, layout.final2)):
            self._write(_PAYLOAD + 4 * i, value)
        return layout

    def enable(self) -> None:
        """Switch the stream on; the registers are locked while it is."""
        self._write(_CONTROL, _ENABLE)

    def disable(self) -> None:
        """Switch the stream off; the camera discards what it has not sent."""
        self._write(_CONTROL, 0)

    def _read(self, offset: int, form: str) -> tuple[int, ...]:
        return struct.unpack(form, self._control.read(self._address + offset, struct.calcsize(form)))

    def _write(self, offset: int, value: int) -> None:
        self._control.write(self._address + offset, struct.pack("<I", value))


def _up(value: int, multiple: int) -> int:
    return -(-value // multiple) * multiple
