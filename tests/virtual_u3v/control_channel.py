"""The control channel: one command at a time, its acknowledge when it is due, and the faults that were ordered."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from typing import final

from tests.virtual_u3v.bulk_in import BulkIn, Message
from tests.virtual_u3v.clock import Clock
from tests.virtual_u3v.faults import FaultInjector
from tests.virtual_u3v.gencp_server import HEADER, PENDING_ACK, Acknowledge, GenCpServer
from tests.virtual_u3v.memory import Status
from tests.virtual_u3v.usb_faults import Stalled, Unplugged

_MS = 1_000_000


@final
class ControlChannel:
    """Takes commands from the control OUT endpoint and puts acknowledges behind the control IN endpoint."""

    def __init__(
        self, server: GenCpServer, endpoint: BulkIn, clock: Clock, injector: Callable[[], FaultInjector]
    ) -> None:
        self._server = server
        self._endpoint = endpoint
        self._clock = clock
        self._injector = injector
        self._previous = b""

    def receive(self, packet: bytes) -> None:
        """A command arrives.

        Raises:
            Unplugged: as ordered.
        """
        injector = self._injector()
        if injector.next_command() == injector.faults.unplug_at_command:
            raise Unplugged("as ordered")
        if injector.take("bad_statuses"):
            acknowledge: Acknowledge | None = self._server.refuse(packet, injector.faults.status)
        else:
            acknowledge = self._server.handle(packet)
        if acknowledge is not None:
            self._answer(acknowledge, injector)

    def _answer(self, acknowledge: Acknowledge, injector: FaultInjector) -> None:
        faults = injector.faults
        due = self._clock.now_ns() + faults.response_ms * _MS
        for _ in range(injector.take_all("pending_acks")):
            self._send(_pending(acknowledge.request_id, faults.pending_ms), due)
            due += faults.pending_ms * _MS * 9 // 10
        if injector.take("late_acks"):
            due += faults.late_ms * _MS
        if injector.take("control_halts"):
            self._endpoint.push(Message(b"", ready_ns=due, fault=Stalled))
            return
        if self._previous and injector.take("stale_acks"):
            self._send(self._previous, due)
        packet = _spoilt(acknowledge, injector)
        self._previous = packet
        if not injector.take("lost_acks"):
            self._send(packet, due)

    def _send(self, packet: bytes, due_ns: int) -> None:
        self._endpoint.push(Message(packet, ready_ns=due_ns))


def _pending(request_id: int, time_ms: int) -> bytes:
    return Acknowledge(Status.SUCCESS, PENDING_ACK, request_id, struct.pack("<HH", 0, time_ms)).to_bytes()


def _spoilt(acknowledge: Acknowledge, injector: FaultInjector) -> bytes:
    if injector.take("wrong_ack_ids"):
        acknowledge = replace(acknowledge, request_id=(acknowledge.request_id + 77) & 0xFFFF)
    if injector.take("wrong_ack_commands"):
        acknowledge = replace(acknowledge, command=acknowledge.command ^ 2)
    if injector.take("garbled_acks"):
        acknowledge = replace(acknowledge, prefix=0xDEAD_BEEF)
    packet = acknowledge.to_bytes()
    return packet[: HEADER.size // 2] if injector.take("short_acks") else packet
