from __future__ import annotations

import errno
import sys
from dataclasses import replace
from typing import Any

import pytest
import usb.backend.libusb1
import usb.core
import usb.util

from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.descriptors import ConfigurationDescriptor, DeviceDescriptor, InterfaceDescriptor
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.model import CameraModel, Speed
from udccal.cameras.protocol import CameraIdentity
from udccal.cameras.u3v.camera import U3vCamera, list_cameras
from udccal.cameras.u3v.discovery import UsbSpeed, find_camera, found_devices
from udccal.errors import CameraBusy, CameraError, CameraLost

SENTENCE = r"Expected .* found .*\. \w+"


def cameras(*serials: str, faults: Faults | None = None) -> list[VirtualCamera]:
    return [VirtualCamera(CameraModel(serial=serial), faults=faults) for serial in serials]


def test_finds_cameras_with_name_speed_and_place() -> None:
    backend = VirtualBackend([*cameras("A1"), VirtualCamera(CameraModel(serial="B2"), speed=Speed.HIGH)])
    first, second = found_devices(backend)
    assert first.identity == CameraIdentity("udccal", "Virtual-U3V", "A1", "u3v")
    assert (first.speed, first.super_speed, first.trouble) == (UsbSpeed.SUPER, True, None)
    assert (first.vendor_id, first.product_id) == (0x1209, 0x0001)
    assert (first.bus, first.address) == (1, 1)
    assert (second.speed, second.super_speed) == (UsbSpeed.HIGH, True)
    assert [identity.serial for identity in list_cameras(backend)] == ["A1", "B2"]


def test_finds_nothing_where_there_is_nothing() -> None:
    (camera,) = cameras("A1")
    camera.unplug()
    assert found_devices(VirtualBackend([camera])) == ()
    assert list_cameras(VirtualBackend([])) == ()


def test_looking_leaves_the_camera_free() -> None:
    backend = VirtualBackend(cameras("A1"))
    found_devices(backend)
    with U3vCamera(backend=backend) as camera:
        (seen,) = found_devices(backend)
        assert seen.identity.serial == "A1"
        assert seen.trouble is not None
        assert "held" in seen.trouble
        assert camera.mode
    assert found_devices(backend)[0].trouble is None


def test_cameras_that_may_not_be_opened_are_listed_with_the_reason() -> None:
    backend = VirtualBackend(cameras("A1", faults=Faults(access_denied=True)))
    (seen,) = found_devices(backend)
    assert seen.identity.serial == ""
    assert seen.trouble is not None
    assert "udev" in seen.trouble
    assert list_cameras(backend) == ()
    with pytest.raises(CameraBusy, match="udev"):
        find_camera("A1", backend)


def test_cameras_held_by_others_are_listed_by_name() -> None:
    backend = VirtualBackend(cameras("A1", faults=Faults(interface_busy=True)))
    (seen,) = found_devices(backend)
    assert (seen.identity.serial, seen.trouble is None) == ("A1", False)
    assert list_cameras(backend)[0].serial == "A1"


def test_cameras_that_are_not_configured_yet_are_listed_and_opened() -> None:
    backend = VirtualBackend(cameras("A1", "B2", faults=Faults(unconfigured=True)))
    with U3vCamera("B2", backend=backend) as camera:
        assert camera.identity.serial == "B2"
        assert len(list(camera.frames(1))) == 1
    backend = VirtualBackend(cameras("A1", "B2", faults=Faults(unconfigured=True)))
    assert [identity.serial for identity in list_cameras(backend)] == ["A1", "B2"]
    assert [seen.trouble for seen in found_devices(backend)] == [None, None]


def test_cameras_that_are_configured_are_not_configured_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(VirtualBackend, "set_configuration")
    with U3vCamera("A1", backend=VirtualBackend(cameras("A1"))) as camera:
        assert camera.identity.serial == "A1"


@pytest.mark.parametrize(("code", "number"), [(-6, errno.EBUSY), (-6, None)])
def test_a_configuration_that_cannot_be_asked_for_is_not_set(
    monkeypatch: pytest.MonkeyPatch, code: int, number: int | None
) -> None:
    def refuse(self: VirtualBackend, dev_handle: object) -> int:
        raise usb.core.USBError("Resource busy", code, number)

    monkeypatch.setattr(VirtualBackend, "get_configuration", refuse)
    monkeypatch.delattr(VirtualBackend, "set_configuration")
    (seen,) = found_devices(VirtualBackend(cameras("A1")))
    assert seen.trouble is not None
    assert "held by another program" in seen.trouble


def test_chooses_by_serial() -> None:
    backend = VirtualBackend(cameras("A1", "B2"))
    assert find_camera("B2", backend)[0].identity.serial == "B2"
    with pytest.raises(CameraError, match=r"A1.*B2.*serial"):
        find_camera(None, backend)
    with pytest.raises(CameraLost, match=r"C3.*A1"):
        find_camera("C3", backend)
    with pytest.raises(CameraLost, match="none"):
        find_camera(None, VirtualBackend([]))


def test_devices_that_are_no_cameras_are_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = VirtualBackend(cameras("A1"))
    descriptor_of = VirtualBackend.get_interface_descriptor

    def without_stream(self: VirtualBackend, dev: object, intf: int, alt: int, config: int) -> object:
        if intf == 2:
            raise IndexError("no such interface")
        return descriptor_of(self, dev, intf, alt, config)  # type: ignore[arg-type]

    monkeypatch.setattr(VirtualBackend, "get_interface_descriptor", without_stream)
    assert found_devices(backend) == ()


def test_a_device_that_goes_while_it_is_looked_at_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(self: VirtualBackend, dev: object, config: int) -> object:
        raise usb.core.USBError("No such device", -4, 19)

    monkeypatch.setattr(VirtualBackend, "get_configuration_descriptor", gone)
    assert found_devices(VirtualBackend(cameras("A1"))) == ()


def test_a_device_without_readable_strings_is_a_trouble(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_string(*arguments: object) -> str:
        raise ValueError("The device has no langid")

    monkeypatch.setattr("usb.util.get_string", no_string)
    (seen,) = found_devices(VirtualBackend(cameras("A1")))
    assert seen.trouble is not None


def test_absent_libusb_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "libusb_package", None)
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: None)
    with pytest.raises(CameraError, match="pip install"):
        found_devices()


def test_libusb_of_the_wheel_can_be_asked() -> None:
    try:
        seen = found_devices()
    except CameraError as error:
        pytest.skip(f"no USB on this machine: {error}")
    assert isinstance(seen, tuple)


@pytest.fixture
def second_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each camera's first configuration, of value 2, is that of another kind of device."""
    of_device, of_configuration = VirtualBackend.get_device_descriptor, VirtualBackend.get_configuration_descriptor

    def device_descriptor(self: VirtualBackend, dev: Any) -> DeviceDescriptor:
        return replace(of_device(self, dev), bNumConfigurations=2)

    def configuration_descriptor(self: VirtualBackend, dev: Any, config: int) -> ConfigurationDescriptor:
        camera = of_configuration(self, dev, max(0, config - 1))
        if config:
            return camera
        other = InterfaceDescriptor(0, 0, (), bInterfaceClass=0xFF, bInterfaceSubClass=0)
        return replace(camera, interfaces=(other,), bConfigurationValue=2)

    monkeypatch.setattr(VirtualBackend, "get_device_descriptor", device_descriptor)
    monkeypatch.setattr(VirtualBackend, "get_configuration_descriptor", configuration_descriptor)


@pytest.mark.usefixtures("second_configuration")
@pytest.mark.parametrize("active", [0, 1, 2])
def test_a_camera_in_another_configuration_than_the_first_is_opened_in_it(active: int) -> None:
    device = VirtualCamera(faults=Faults(unconfigured=True))
    device._pipe.configuration = active
    backend = VirtualBackend([device])
    (seen,) = found_devices(backend)
    assert (seen.identity.serial, seen.super_speed, seen.trouble) == ("V0000001", True, None)
    device._pipe.configuration = active
    with U3vCamera(backend=backend) as camera:
        assert len(list(camera.frames(1))) == 1


def test_a_camera_that_lacks_one_string_keeps_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    get_string = usb.util.get_string

    def without_vendor(device: Any, index: int) -> Any:
        if index == 1:
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
        return get_string(device, index)

    def odd_vendor(device: Any, index: int) -> Any:
        return b"\0".decode("utf-16-le") if index == 1 else get_string(device, index)

    for strings in (without_vendor, odd_vendor):
        monkeypatch.setattr("usb.util.get_string", strings)
        backend = VirtualBackend(cameras("A1"))
        (seen,) = found_devices(backend)
        assert seen.identity == CameraIdentity("", "Virtual-U3V", "A1", "u3v")
        assert seen.trouble is None
        with U3vCamera("A1", backend=backend) as camera:
            assert camera.identity.vendor == "udccal"
