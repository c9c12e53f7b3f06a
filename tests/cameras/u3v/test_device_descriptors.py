"""Descriptors of the virtual USB3 Vision camera."""

from __future__ import annotations

import struct

import pytest
import usb.control
import usb.core
import usb.util

from tests.cameras.u3v.device_host import host_of
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.descriptors import CONTROL_IN, EVENT_IN, STREAM_IN
from tests.virtual_u3v.model import CameraModel, Speed


def test_descriptors_are_those_of_a_usb3_vision_camera() -> None:
    device = host_of(VirtualCamera()).device
    assert (device.bDeviceClass, device.bDeviceSubClass, device.bDeviceProtocol) == (0xEF, 0x02, 0x01)
    interfaces = list(device.get_active_configuration())
    kinds = [(i.bInterfaceClass, i.bInterfaceSubClass, i.bInterfaceProtocol) for i in interfaces]
    assert kinds == [(0xEF, 5, 0), (0xEF, 5, 1), (0xEF, 5, 2)]
    endpoints = [[e.bEndpointAddress for e in i] for i in interfaces]
    assert endpoints == [[0x01, CONTROL_IN], [EVENT_IN], [STREAM_IN]]
    assert (device.manufacturer, device.product, device.serial_number) == ("udccal", "Virtual-U3V", "V0000001")


def test_device_info_descriptor_and_association_are_in_their_places() -> None:
    device = host_of(VirtualCamera()).device
    configuration = device.get_active_configuration()
    assert list(configuration.extra_descriptors) == [8, 11, 0, 3, 0xEF, 5, 0, 0]
    info = bytes(configuration[(0, 0)].extra_descriptors)
    length, kind, subtype, gencp_minor, gencp_major, u3v_minor, u3v_major = struct.unpack_from("<BBBHHHH", info)
    assert (length, kind, subtype) == (len(info), 0x24, 1)
    assert (gencp_major, gencp_minor, u3v_major, u3v_minor) == (1, 1, 1, 0)
    assert usb.util.get_string(device, info[11]).startswith("1209")
    assert usb.util.get_string(device, info[17]) == "V0000001"
    assert info[19] == 0b1100


def test_total_length_counts_every_byte() -> None:
    descriptors = VirtualCamera().descriptors
    raw = descriptors.configuration.to_bytes()
    assert struct.unpack_from("<H", raw, 2)[0] == len(raw)
    lengths, place = [], 0
    while place < len(raw):
        lengths.append(raw[place])
        place += raw[place]
    assert place == len(raw)
    assert lengths == [9, 8, 9, 20, 7, 6, 7, 6, 9, 7, 6, 9, 7, 6]


@pytest.mark.parametrize(("speed", "packet", "bit"), [(Speed.SUPER, 1024, 8), (Speed.HIGH, 512, 4)])
def test_speed_of_the_link_is_told(speed: Speed, packet: int, bit: int) -> None:
    host = host_of(VirtualCamera(speed=speed))
    assert host.device.speed == speed
    assert host.device[0][(2, 0)][0].wMaxPacketSize == packet
    assert host.get(at.CURRENT_SPEED) == bit


def test_camera_without_events_has_two_interfaces() -> None:
    host = host_of(VirtualCamera(CameraModel(event_interface=False)))
    assert [i.bInterfaceProtocol for i in host.device.get_active_configuration()] == [0, 2]
    assert host.get(at.U3VCP_CAPABILITY) == 1
