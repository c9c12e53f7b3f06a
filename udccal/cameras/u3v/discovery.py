"""Finds USB3 Vision cameras that are plugged in, and reads their descriptors."""

from __future__ import annotations

import contextlib
import enum
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, final

import usb.backend.libusb1
import usb.core
import usb.util

from udccal.cameras.protocol import CameraIdentity
from udccal.cameras.u3v.usb_errors import EndpointHalted, usb_errors
from udccal.errors import CameraBusy, CameraError, CameraLost

BACKEND: Final = "u3v"

# Interface class, subclass and protocols (USB3 Vision, interface descriptors).
_CLASS, _SUBCLASS = 0xEF, 0x05
_CONTROL, _STREAM = 0, 2
_ENDPOINT_IN: Final = 0x80
_BULK: Final = 2
# The device info descriptor behind the control interface's (USB3 Vision): class-specific interface
# descriptor, subtype device info, versions of GenCP and of USB3 Vision, then indices of strings and a mask of speeds.
_DEVICE_INFO: Final = struct.Struct("<BBBII9B")
_DEVICE_INFO_HEAD: Final = (0x24, 0x01)
_SUPER_SPEED_MASK: Final = 0b11000


@final
class UsbSpeed(enum.IntEnum):
    """Speed of a link, numbered as libusb does."""

    UNKNOWN = 0
    LOW = 1
    FULL = 2
    HIGH = 3
    SUPER = 4
    SUPER_PLUS = 5


@final
@dataclass(frozen=True)
class UsbInterfaces:
    """Value of the configuration, numbers of the interfaces to claim in it, and addresses of the endpoints."""

    configuration: int
    numbers: tuple[int, ...]
    control_in: int
    control_out: int
    stream_in: int


@final
@dataclass(frozen=True)
class FoundDevice:
    """A camera at a port, whether or not it can be opened.

    Attributes:
        identity: vendor, model and serial from its descriptors; the serial is empty when it is not readable.
        vendor_id, product_id: USB's numbers, for a udev rule.
        super_speed: whether it supports SuperSpeed; with a slower ``speed`` it is at the wrong port or cable.
        trouble: why it cannot be opened, as a sentence; None when it can.
    """

    identity: CameraIdentity
    vendor_id: int
    product_id: int
    bus: int
    address: int
    speed: UsbSpeed
    super_speed: bool
    trouble: str | None


@final
@dataclass(frozen=True)
class UsbCamera:
    """A camera's pyusb device and interfaces."""

    device: Any
    interfaces: UsbInterfaces


def found_devices(backend: Any = None) -> tuple[FoundDevice, ...]:
    """List every USB3 Vision camera at this machine, also those that are held by others or may not be opened.

    Args:
        backend: pyusb's backend; None for libusb from its wheel, else from the system.

    Raises:
        CameraError: when there is no libusb.
    """
    return tuple(_found(camera) for camera in _usb_cameras(backend))


def find_camera(serial: str | None, backend: Any = None) -> tuple[FoundDevice, UsbCamera]:
    """Return the camera with that serial, or the only one.

    Raises:
        CameraLost: when it is not plugged in.
        CameraBusy: when missing permission hides the serial of a camera.
        CameraError: when no serial is given and there are several, or there is no libusb.
    """
    found = [(_found(camera), camera) for camera in _usb_cameras(backend)]
    chosen = [pair for pair in found if serial is None or pair[0].identity.serial == serial]
    if len(chosen) == 1:
        return chosen[0]
    seen = ", ".join(f"{device.identity.model} {device.identity.serial}" for device, _ in found) or "none"
    if chosen:
        raise CameraError(f"Expected one USB3 Vision camera, found {seen}. Give its serial.")
    trouble = next((device.trouble for device, _ in found if device.trouble and not device.identity.serial), None)
    if trouble is not None:
        raise CameraBusy(trouble)
    wanted = "a USB3 Vision camera" if serial is None else f"USB3 Vision camera {serial}"
    raise CameraLost(f"Expected {wanted}, found {seen}. Plug it in and check that it has power.")


def configure(device: Any, configuration: int) -> None:
    """Choose a pyusb device's configuration if it is not chosen; to choose it again would disturb the device.

    Raises:
        usb.core.USBError: when USB fails, or another program uses another configuration of the device.
    """
    try:
        active = device.get_active_configuration().bConfigurationValue
    except usb.core.USBError as error:
        if (error.errno, error.backend_error_code) != (None, None):  # pyusb's own error has neither
            raise
        active = None
    if active != configuration:
        device.set_configuration(configuration)


def _usb_cameras(backend: Any) -> Iterator[UsbCamera]:
    with usb_errors("looking for cameras"):
        devices = list(usb.core.find(find_all=True, backend=backend or _libusb()))
    for device in devices:
        # A device may vanish after it was listed.
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            interfaces = _interfaces_of(device)
            if interfaces is not None:
                yield UsbCamera(device, interfaces)


def _libusb() -> Any:
    """Return libusb from its wheel, else from the system."""
    backend = None
    with contextlib.suppress(ImportError):
        import libusb_package

        backend = libusb_package.get_libusb1_backend()
    backend = backend or usb.backend.libusb1.get_backend()
    if backend is None:
        raise CameraError(
            "Expected libusb, found none. Install it with: pip install libusb-package (or from the system, e.g. "
            "apt install libusb-1.0-0)."
        )
    return backend


def _interfaces_of(device: Any) -> UsbInterfaces | None:
    for configuration in device:
        control = stream = None
        for interface in configuration:
            if (interface.bInterfaceClass, interface.bInterfaceSubClass) == (_CLASS, _SUBCLASS):
                control = interface if interface.bInterfaceProtocol == _CONTROL else control
                stream = interface if interface.bInterfaceProtocol == _STREAM else stream
        if control is not None and stream is not None:
            inward, outward, streaming = _bulk(control, True), _bulk(control, False), _bulk(stream, True)
            if inward is not None and outward is not None and streaming is not None:
                numbers = (control.bInterfaceNumber, stream.bInterfaceNumber)
                return UsbInterfaces(configuration.bConfigurationValue, numbers, inward, outward, streaming)
    return None


def _bulk(interface: Any, inward: bool) -> int | None:
    for endpoint in interface:
        address = int(endpoint.bEndpointAddress)
        if bool(address & _ENDPOINT_IN) == inward and endpoint.bmAttributes & 3 == _BULK:
            return address
    return None


def _found(camera: UsbCamera) -> FoundDevice:
    device = camera.device
    vendor, model, serial, super_speed = 0, 0, 0, False
    info = _device_info(camera)
    if info is not None:
        vendor, model, serial = info[6], info[7], info[11]
        super_speed = bool(info[13] & _SUPER_SPEED_MASK)
    indices = (vendor or device.iManufacturer, model or device.iProduct, serial or device.iSerialNumber)
    texts, trouble = _texts_and_trouble(camera, indices)
    try:
        speed = UsbSpeed(device.speed or 0)
    except ValueError:
        speed = UsbSpeed.SUPER_PLUS  # a libusb newer than this list has faster ones
    identity = CameraIdentity(*texts, BACKEND)
    numbers = (device.idVendor, device.idProduct, device.bus or 0, device.address or 0)
    return FoundDevice(identity, *numbers, speed, super_speed, trouble)


def _device_info(camera: UsbCamera) -> tuple[int, ...] | None:
    chosen = usb.util.find_descriptor(camera.device, bConfigurationValue=camera.interfaces.configuration)
    for interface in chosen:
        extra = bytes(interface.extra_descriptors)
        is_control = interface.bInterfaceNumber == camera.interfaces.numbers[0]
        if is_control and len(extra) >= _DEVICE_INFO.size and (extra[1], extra[2]) == _DEVICE_INFO_HEAD:
            return _DEVICE_INFO.unpack_from(extra)
    return None


def _texts_and_trouble(camera: UsbCamera, indices: tuple[int, ...]) -> tuple[tuple[str, str, str], str | None]:
    """Return the readable strings, and the reason why the camera cannot be opened."""
    device, texts, trouble = camera.device, ["", "", ""], None
    control = camera.interfaces.numbers[0]
    try:
        with usb_errors("asking the camera for its name"):
            # This opens it, so that a refusal is not taken for a camera without strings.
            configure(device, camera.interfaces.configuration)
            for i, index in enumerate(indices):
                # A camera stalls the request of a string that it does not have.
                with contextlib.suppress(EndpointHalted), usb_errors("asking the camera for its name"):
                    texts[i] = _text(device, index)
            usb.util.claim_interface(device, control)
            usb.util.release_interface(device, control)
    except CameraError as error:
        trouble = str(error)
    finally:
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            usb.util.dispose_resources(device)
    return (texts[0], texts[1], texts[2]), trouble


def _text(device: Any, index: int) -> str:
    if not index:
        return ""
    try:
        text = usb.util.get_string(device, index) or ""
    except (IndexError, UnicodeDecodeError):
        return ""
    except ValueError:
        # pyusb's message for a device without valid string descriptors.
        raise CameraLost("Expected the camera's name, found no readable string. Plug it in again.") from None
    return "".join(c for c in text if c.isprintable()).strip()
