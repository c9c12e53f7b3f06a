"""The virtual camera's control channel, questioned byte by byte, without the driver."""

from __future__ import annotations

import struct
from collections.abc import Callable

import pytest
import usb.control
import usb.core
import usb.util

from tests.cameras.u3v.device_host import host_of, manual
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.descriptors import EVENT_IN
from tests.virtual_u3v.memory import Status
from tests.virtual_u3v.raw_host import RawHost


def test_bootstrap_registers_say_who_it_is() -> None:
    host = host_of(VirtualCamera())
    assert host.readmem(0x144, 64).data.rstrip(b"\0") == b"V0000001"
    assert host.readmem(0x004, 64).data.rstrip(b"\0") == b"udccal"
    assert host.get(at.GENCP_VERSION) == 0x00010001
    assert (host.get(at.SBRM_ADDRESS), host.get(at.SIRM_ADDRESS)) == (at.SBRM, at.SIRM)


def test_user_defined_name_is_kept_until_the_power_goes() -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    assert host.writemem(0x184, b"left one".ljust(64, b"\0")).status == 0
    assert host.readmem(0x184, 8).data == b"left one"
    camera.unplug()
    camera.plug()
    assert host_of(camera).readmem(0x184, 8).data == bytes(8)


@pytest.mark.parametrize(
    ("ask", "status"),
    [
        (lambda h: h.readmem(0x0900_0000, 4), Status.INVALID_ADDRESS),
        (lambda h: h.readmem(at.FEATURES + 0xFFC, 8), Status.INVALID_ADDRESS),
        (lambda h: h.readmem(0, 1013), Status.INVALID_PARAMETER),
        (lambda h: h.readmem(at.ACQUISITION_START.address, 4), Status.ACCESS_DENIED),
        (lambda h: h.writemem(0x144, bytes(64)), Status.WRITE_PROTECT),
        (lambda h: h.writemem(at.WIDTH.address, bytes(2)), Status.BAD_ALIGNMENT),
        (lambda h: h.writemem(at.WIDTH.address + 4, bytes(2)), Status.BAD_ALIGNMENT),
        (lambda h: h.ask(0x0806, bytes(4)), Status.NOT_IMPLEMENTED),
        (lambda h: h.ask(0x0800, bytes(4)), Status.INVALID_HEADER),
    ],
)
def test_refuses_what_it_should(ask: Callable[[RawHost], object], status: Status) -> None:
    ack = ask(host_of(VirtualCamera()))
    assert (ack.status, ack.data) == (status, b"")


def test_command_whose_length_lies_is_refused() -> None:
    host = host_of(VirtualCamera())
    host.send(0x0800, bytes(12), length=13)
    assert host.acknowledge().status == Status.INVALID_HEADER


def test_command_that_wants_no_acknowledge_gets_none() -> None:
    host = host_of(VirtualCamera())
    host.send(0x0802, struct.pack("<QI", at.EXPOSURE_AUTO.address, 0), flags=0)
    with pytest.raises(usb.core.USBTimeoutError):
        host.acknowledge()
    assert host.get(at.EXPOSURE_AUTO) == 0


@pytest.mark.parametrize(
    ("register", "value", "status"),
    [
        (at.WIDTH, 120, Status.SUCCESS),
        (at.WIDTH, 121, Status.INVALID_PARAMETER),
        (at.WIDTH, 136, Status.INVALID_PARAMETER),
        (at.OFFSET_X, 4, Status.INVALID_PARAMETER),  # no room beside the full width
        (at.HEIGHT, 0, Status.INVALID_PARAMETER),
        (at.PIXEL_FORMAT, 0x01080001, Status.INVALID_PARAMETER),  # Mono8 of a colour sensor
        (at.PIXEL_FORMAT, 0x010C0059, Status.SUCCESS),
        (at.EXPOSURE_TIME_RAW, 50_000, Status.ACCESS_DENIED),  # the automatic has it
        (at.GAIN_RAW, 10, Status.ACCESS_DENIED),
        (at.TRIGGER_SOURCE, 2, Status.INVALID_PARAMETER),
        (at.SI_PAYLOAD_TRANSFER_SIZE, 1000, Status.PAYLOAD_SIZE_NOT_ALIGNED),
        (at.SI_CONTROL, 1, Status.STREAM_REGISTERS_INCONSISTENT),
    ],
)
def test_features_have_limits(register: at.Register, value: int, status: Status) -> None:
    assert host_of(VirtualCamera()).set(register, value) == status


def test_exposure_is_rounded_down_without_a_word() -> None:
    host = host_of(VirtualCamera())
    manual(host)
    assert host.set(at.EXPOSURE_TIME_RAW, 40_034) == 0
    assert host.get(at.EXPOSURE_TIME_RAW) == 40_000
    assert host.set(at.EXPOSURE_TIME_RAW, 199) == Status.INVALID_PARAMETER


def test_nothing_changes_while_frames_are_taken() -> None:
    host = host_of(VirtualCamera())
    host.start()
    refused = [host.set(r, host.get(r)) for r in (at.WIDTH, at.PIXEL_FORMAT, at.SI_PAYLOAD_TRANSFER_SIZE)]
    assert refused == [Status.ACCESS_DENIED] * 3
    host.stop()
    assert host.set(at.WIDTH, 64) == 0


def test_event_interface_sends_its_test_event_when_switched_on() -> None:
    host = host_of(VirtualCamera())
    assert host.set(at.EI_EVENT_TEST_CONTROL, 1) == Status.ACCESS_DENIED
    assert host.set(at.EI_CONTROL, 1) == 0
    assert host.set(at.EI_EVENT_TEST_CONTROL, 1) == 0
    event = bytes(host.device.read(EVENT_IN, 1024, 1000))
    assert event[:4] == b"U3VE"
    assert struct.unpack_from("<HHH", event, 6)[0] == 0x0C00
    assert struct.unpack_from("<H", event, 14)[0] == 0x4FFF
