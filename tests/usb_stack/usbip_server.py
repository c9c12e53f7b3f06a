"""A virtual camera behind a USB/IP connection."""

from __future__ import annotations

import errno
import select
import socket
import threading
from collections import deque
from typing import final

from tests.usb_stack.usbip import HEADER_SIZE, BadMessage, Submit, Unlink, parse, submitted, unlinked
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.descriptors import STREAM_IN
from tests.virtual_u3v.standard_requests import Setup
from tests.virtual_u3v.usb_faults import Overflowed, Stalled, Unplugged

# While a transfer waits for the camera, this often somebody looks whether it was unplugged.
_LOOK_S = 0.005


@final
class UsbIpServer:
    """Answers the host's transfers from a camera until the camera is unplugged or the host lets go.

    Args:
        connection: a connected stream socket, which the server closes when it ends.
    """

    def __init__(self, camera: VirtualCamera, connection: socket.socket) -> None:
        self._camera = camera
        self._connection = connection
        self._waiting: dict[int, deque[Submit]] = {}
        self._thread = threading.Thread(target=self._serve, name="usbip", daemon=True)
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait until the server has ended; whether it has."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _serve(self) -> None:
        with self._connection:
            try:
                while self._camera.plugged:
                    if not self._take_messages() and not self._answer():
                        select.select([self._connection], [], [], self._pause_s())
            except (Unplugged, ConnectionError, BadMessage):
                return  # closing the connection is all that the protocol has to say

    def _take_messages(self) -> bool:
        """Take one message if one has come; whether there was one."""
        if not select.select([self._connection], [], [], 0)[0]:
            return False
        message = parse(self._receive(HEADER_SIZE))
        if isinstance(message, Unlink):
            self._unlink(message)
        elif message.endpoint == 0:
            self._control(message)
        elif message.inward:
            self._waiting.setdefault(message.address, deque()).append(message)
        else:
            self._outward(message)
        return True

    def _answer(self) -> bool:
        """Do what can be done now, but one stream transfer at most, so that commands need not wait; whether any was."""
        order = sorted(self._waiting, key=lambda address: address == STREAM_IN)
        return any([self._inward(self._waiting[address]) for address in order if self._waiting[address]])

    def _inward(self, waiting: deque[Submit]) -> bool:
        submit = waiting[0]
        try:
            data = self._camera.bulk_in(submit.address, submit.length)
        except (Stalled, Overflowed) as fault:
            waiting.popleft()
            self._reply(submit, _status(fault))
            return True
        if data is None:
            return False
        waiting.popleft()
        self._reply(submit, 0, data)
        return True

    def _outward(self, submit: Submit) -> None:
        data = self._receive(submit.length)
        try:
            self._camera.bulk_out(submit.address, data)
        except Stalled as fault:
            self._reply(submit, _status(fault))
        else:
            self._connection.sendall(submitted(submit, 0, submit.length))

    def _control(self, submit: Submit) -> None:
        if not submit.inward:
            self._receive(submit.length)
        try:
            data = self._camera.control(Setup.from_bytes(submit.setup))
        except Stalled as fault:
            self._reply(submit, _status(fault))
        else:
            self._reply(submit, 0, data)

    def _unlink(self, unlink: Unlink) -> None:
        for waiting in self._waiting.values():
            for submit in waiting:
                if submit.sequence == unlink.unwanted:
                    waiting.remove(submit)
                    self._connection.sendall(unlinked(unlink, -errno.ECONNRESET))
                    return
        self._connection.sendall(unlinked(unlink, 0))

    def _reply(self, submit: Submit, status: int, data: bytes | memoryview = b"") -> None:
        self._connection.sendall(submitted(submit, status, len(data)))
        if data:
            self._connection.sendall(data)

    def _receive(self, length: int) -> bytes:
        data = bytearray()
        while len(data) < length:
            part = self._connection.recv(length - len(data))
            if not part:
                raise ConnectionResetError("the host let go")
            data += part
        return bytes(data)

    def _pause_s(self) -> float:
        """How long nothing can happen, at most until the next look."""
        times = [self._camera.ready_ns(address) for address, waiting in self._waiting.items() if waiting]
        due = [(ready - self._camera.clock.now_ns()) * 1e-9 for ready in times if ready is not None]
        return min([_LOOK_S, *(max(0.0, left) for left in due)])


def _status(fault: Stalled | Overflowed) -> int:
    return -errno.EPIPE if isinstance(fault, Stalled) else -errno.EOVERFLOW
