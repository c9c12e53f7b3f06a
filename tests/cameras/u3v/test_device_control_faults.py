"""Faults of the virtual camera's control channel are what they are called."""

from __future__ import annotations

import errno
import struct

import pytest
import usb.control
import usb.core
import usb.util

from tests.cameras.u3v.device_host import host_of
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.descriptors import CONTROL_IN
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.gencp_server import PENDING_ACK
from tests.virtual_u3v.memory import Status


def test_pending_acknowledges_come_first_and_take_their_time() -> None:
    camera = VirtualCamera(faults=Faults(pending_acks=2, pending_ms=1000))
    host = host_of(camera)
    host.send(0x0800, struct.pack("<QHH", 0, 0, 4))
    first, second = host.acknowledge(200), host.acknowledge(1000)
    assert [(a.command, a.request_id) for a in (first, second)] == [(PENDING_ACK, 1)] * 2
    assert struct.unpack("<HH", first.data) == (0, 1000)
    with pytest.raises(usb.core.USBTimeoutError):
        host.acknowledge(200)
    assert host.acknowledge(1000).command == 0x0801
    assert host.get(at.GENCP_VERSION) == 0x00010001


def test_stale_acknowledge_comes_before_the_right_one() -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    host.get(at.GENCP_VERSION)
    camera.inject(Faults(stale_acks=1))
    assert [host.readmem(0x1CC, 4).request_id, host.acknowledge().request_id] == [1, 2]


def test_lost_acknowledge_never_comes_though_the_command_was_done() -> None:
    camera = VirtualCamera(faults=Faults(lost_acks=1))
    host = host_of(camera)
    with pytest.raises(usb.core.USBTimeoutError):
        host.set(at.EXPOSURE_AUTO, 0)
    assert host.get(at.EXPOSURE_AUTO) == 0


def test_late_acknowledge_meets_the_next_command() -> None:
    host = host_of(VirtualCamera(faults=Faults(late_acks=1, late_ms=1500)))
    with pytest.raises(usb.core.USBTimeoutError):
        host.readmem(0, 4)
    assert [host.readmem(0, 4).request_id, host.acknowledge().request_id] == [1, 2]


@pytest.mark.parametrize(
    ("faults", "field", "found"),
    [
        (Faults(wrong_ack_ids=1), "request_id", 78),
        (Faults(wrong_ack_commands=1), "command", 0x0803),
        (Faults(garbled_acks=1), "prefix", 0xDEADBEEF),
        (Faults(bad_statuses=1, status=Status.BUSY), "status", Status.BUSY),
    ],
)
def test_spoilt_acknowledges(faults: Faults, field: str, found: int) -> None:
    host = host_of(VirtualCamera(faults=faults))
    assert getattr(host.readmem(0, 4), field) == found
    assert (host.readmem(0, 4).request_id, host.readmem(0, 4).status) == (2, 0)


def test_short_acknowledge_is_cut_in_its_header() -> None:
    host = host_of(VirtualCamera(faults=Faults(short_acks=1)))
    host.send(0x0800, struct.pack("<QHH", 0, 0, 4))
    assert len(host.device.read(CONTROL_IN, 1024, 1000)) == 6


def test_refused_command_is_not_carried_out() -> None:
    host = host_of(VirtualCamera(faults=Faults(bad_statuses=1)))
    assert host.set(at.EXPOSURE_AUTO, 0) == Status.BUSY
    assert host.get(at.EXPOSURE_AUTO) == 2


def test_control_halt_lasts_until_cleared() -> None:
    host = host_of(VirtualCamera(faults=Faults(control_halts=1)))
    for _ in range(2):
        with pytest.raises(usb.core.USBError) as error:
            host.readmem(0, 4)
        assert (error.value.errno, error.value.backend_error_code) == (errno.EPIPE, -9)
    host.device.clear_halt(CONTROL_IN)
    assert host.acknowledge().request_id == 2


def test_slow_camera_takes_its_time() -> None:
    camera = VirtualCamera(faults=Faults(response_ms=150))
    host_of(camera).get(at.GENCP_VERSION)
    assert camera.clock.now_ns() == 150_000_000


def test_unplug_during_a_command() -> None:
    camera = VirtualCamera(faults=Faults(unplug_at_command=1))
    host = host_of(camera)
    host.get(at.GENCP_VERSION)
    with pytest.raises(usb.core.USBError) as error:
        host.get(at.GENCP_VERSION)
    assert error.value.errno == errno.ENODEV
    assert not camera.plugged
