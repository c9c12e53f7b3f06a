"""The USB/IP server without a kernel: messages made by hand at the other end of a socket pair."""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from tests.usb_stack.usbip import HEADER_SIZE, BadMessage, Command, Submit, Unlink, parse
from tests.usb_stack.usbip_server import UsbIpServer
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.clock import WallClock
from tests.virtual_u3v.faults import Faults

READMEM = struct.pack("<IHHHHQHH", 0x43563355, 0x4000, 0x0800, 12, 1, at.WIDTH.address, 0, 4)
END_S = 5.0


@dataclass(frozen=True)
class Answer:
    """What the server says: kind, which transfer, how it went, how many bytes, and the bytes of an inward one."""

    command: int
    sequence: int
    status: int
    actual: int
    data: bytes


class Kernel:
    """The other end."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection

    def submit(self, sequence: int, endpoint: int, length: int, data: bytes = b"", setup: bytes = bytes(8)) -> None:
        inward = not data and (endpoint > 0 or setup[0] & 0x80 > 0)
        head = struct.pack(">5I", Command.CMD_SUBMIT, sequence, 65538, int(inward), endpoint)
        self.connection.sendall(head + struct.pack(">Iiiii", 0, length, 0, 0, 0) + setup + data)

    def unlink(self, sequence: int, unwanted: int) -> None:
        self.connection.sendall(struct.pack(">6I24x", Command.CMD_UNLINK, sequence, 65538, 0, 0, unwanted))

    def answer(self, inward: bool = True) -> Answer:
        head = self.receive(HEADER_SIZE)
        command, sequence = struct.unpack_from(">2I", head)
        status, actual = struct.unpack_from(">2i", head, 20)
        wanted = actual if inward and command == Command.RET_SUBMIT else 0
        return Answer(command, sequence, status, actual, self.receive(wanted))

    def receive(self, length: int) -> bytes:
        data = b""
        while len(data) < length:
            part = self.connection.recv(length - len(data))
            if not part:
                raise ConnectionResetError
            data += part
        return data


@pytest.fixture
def camera() -> VirtualCamera:
    return VirtualCamera(clock=WallClock())


@pytest.fixture
def kernel(camera: VirtualCamera) -> Iterator[Kernel]:
    kernel_end, own_end = socket.socketpair()
    kernel_end.settimeout(END_S)
    server = UsbIpServer(camera, own_end)
    with kernel_end:
        yield Kernel(kernel_end)
    assert server.join(END_S)


def start(kernel: Kernel, transfer: int = 12288) -> None:
    """Switch the stream on, by commands made by hand."""
    sizes = struct.pack("<6I", 1024, transfer, 12288 // transfer, 0, 0, 1024)
    writes = ((at.SI_MAXIMUM_LEADER_SIZE, sizes), (at.SI_CONTROL, b"\1\0\0\0"), (at.ACQUISITION_START, b"\1\0\0\0"))
    for sequence, (register, data) in enumerate(writes):
        head = struct.pack("<IHHHHQ", 0x43563355, 0x4000, 0x0802, 8 + len(data), sequence, register.address)
        kernel.submit(900 + 2 * sequence, 1, len(head + data), head + data)
        kernel.submit(901 + 2 * sequence, 1, 1024)
        assert kernel.answer(inward=False).status == 0
        assert struct.unpack_from("<H", kernel.answer().data, 4)[0] == 0


def test_descriptors_come_over_endpoint_0(kernel: Kernel, camera: VirtualCamera) -> None:
    kernel.submit(1, 0, 18, setup=struct.pack("<BBHHH", 0x80, 6, 0x0100, 0, 18))
    assert kernel.answer() == Answer(Command.RET_SUBMIT, 1, 0, 18, camera.descriptors.device.to_bytes())
    kernel.submit(2, 0, 8, setup=struct.pack("<BBHHH", 0x80, 6, 0x0700, 0, 8))
    assert kernel.answer() == Answer(Command.RET_SUBMIT, 2, -errno.EPIPE, 0, b"")


def test_command_and_acknowledge(kernel: Kernel) -> None:
    kernel.submit(1, 1, len(READMEM), READMEM)
    assert kernel.answer(inward=False) == Answer(Command.RET_SUBMIT, 1, 0, len(READMEM), b"")
    kernel.submit(2, 1, 1024)
    answer = kernel.answer()
    assert (answer.sequence, answer.status, answer.data[-4:]) == (2, 0, struct.pack("<I", 128))


def test_transfer_that_waits_can_be_taken_back_and_one_that_is_done_cannot(kernel: Kernel) -> None:
    kernel.submit(1, 1, 1024)
    kernel.unlink(2, 1)
    assert kernel.answer() == Answer(Command.RET_UNLINK, 2, -errno.ECONNRESET, 0, b"")
    kernel.unlink(3, 1)
    assert kernel.answer() == Answer(Command.RET_UNLINK, 3, 0, 0, b"")
    kernel.submit(4, 1, len(READMEM), READMEM)
    assert kernel.answer(inward=False).sequence == 4
    kernel.submit(5, 1, 1024)
    assert len(kernel.answer().data) == 16  # the acknowledge was kept for it


def test_the_right_one_of_many_transfers_is_taken_back(kernel: Kernel) -> None:
    for sequence in (1, 2, 3):
        kernel.submit(sequence, 3, 1024)
    for sequence, unwanted in ((4, 2), (5, 1), (6, 2), (7, 3)):
        kernel.unlink(sequence, unwanted)
    answers = [kernel.answer() for _ in range(4)]
    assert [(a.sequence, a.status) for a in answers] == [(4, -104), (5, -104), (6, 0), (7, -104)]


def test_commands_pass_transfers_that_wait_for_a_frame(kernel: Kernel) -> None:
    for sequence in (1, 2, 3):
        kernel.submit(sequence, 3, 1024)
    kernel.submit(4, 1, len(READMEM), READMEM)
    kernel.submit(5, 1, 1024)
    assert [kernel.answer(inward=False).sequence, kernel.answer().sequence] == [4, 5]


def test_queued_stream_transfers_are_filled_in_order(kernel: Kernel) -> None:
    start(kernel)
    for sequence, length in enumerate((1024, 12288, 1024), 1):
        kernel.submit(sequence, 3, length)
    answers = [kernel.answer() for _ in range(3)]
    assert [(a.sequence, a.status, a.actual) for a in answers] == [(1, 0, 52), (2, 0, 12288), (3, 0, 32)]
    assert [answers[0].data[:4], answers[2].data[:4]] == [b"U3VL", b"U3VT"]


@pytest.mark.parametrize(
    ("faults", "status"),
    [(Faults(babble_frames=(0,)), -errno.EOVERFLOW), (Faults(stream_halts=(0,)), -errno.EPIPE)],
)
def test_errors_of_the_bus_are_told(kernel: Kernel, camera: VirtualCamera, faults: Faults, status: int) -> None:
    camera.inject(faults)
    start(kernel, 4096)
    for sequence, length in enumerate((1024, 4096, 4096), 1):
        kernel.submit(sequence, 3, length)
    assert [kernel.answer().status for _ in range(3)] == [0, 0, status]


def test_unplugged_camera_ends_the_connection(kernel: Kernel, camera: VirtualCamera) -> None:
    kernel.submit(1, 3, 1024)
    camera.unplug()
    with pytest.raises(ConnectionResetError):
        kernel.answer()


def test_nonsense_ends_the_connection(kernel: Kernel) -> None:
    kernel.connection.sendall(b"\xff" * HEADER_SIZE)
    with pytest.raises(ConnectionResetError):
        kernel.answer()


def test_messages_are_taken_apart() -> None:
    head = struct.pack(">5IIiiii", 1, 7, 65538, 1, 3, 0, 4096, 0, 0, 0) + b"\x80\x06\x00\x01\x00\x00\x12\x00"
    assert parse(head) == Submit(7, 3, True, 4096, head[40:])
    assert parse(struct.pack(">6I24x", 2, 8, 65538, 0, 0, 7)) == Unlink(8, 7)


@pytest.mark.parametrize(
    ("command", "endpoint", "length"), [(3, 1, 16), (0, 1, 16), (1, 16, 16), (1, 1, -1), (1, 1, 1 << 27)]
)
def test_what_is_no_message_is_refused(command: int, endpoint: int, length: int) -> None:
    with pytest.raises(BadMessage):
        parse(struct.pack(">5IIiiii8x", command, 1, 65538, 1, endpoint, 0, length, 0, 0, 0))
