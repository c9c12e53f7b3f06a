"""USB descriptors of a USB3 Vision camera.

Standard ones after USB 3.x §9.6, the interface association after its ECN, the camera's own after USB3 Vision 1.0 §3
(device class EF/02/01; interfaces EF/05 with protocol 0 control, 1 event, 2 streaming; device info descriptor).
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass, field

from tests.virtual_u3v.model import CameraModel, Speed

CONTROL_OUT, CONTROL_IN, EVENT_IN, STREAM_IN = 0x01, 0x81, 0x82, 0x83
VENDOR_ID, PRODUCT_ID = 0x1209, 0x0001  # pid.codes' identifier for tests
_ENGLISH = 0x0409
_BURST = 15


class Kind(enum.IntEnum):
    """Types of descriptors (USB 3.x, table 9-6; U3V_INTERFACE after USB3 Vision 1.0 §3)."""

    DEVICE = 1
    CONFIGURATION = 2
    STRING = 3
    INTERFACE = 4
    ENDPOINT = 5
    INTERFACE_ASSOCIATION = 11
    BOS = 15
    DEVICE_CAPABILITY = 16
    U3V_INTERFACE = 0x24
    SUPERSPEED_COMPANION = 48


@dataclass(frozen=True)
class EndpointDescriptor:
    """A bulk endpoint, with the fields that a host library shows."""

    bEndpointAddress: int
    wMaxPacketSize: int
    bmAttributes: int = 2
    bInterval: int = 0
    bLength: int = 7
    bDescriptorType: int = Kind.ENDPOINT
    bRefresh: int = 0
    bSynchAddress: int = 0
    extra_descriptors: tuple[int, ...] = ()

    def to_bytes(self) -> bytes:
        """As on the wire, with the companion descriptor that follows it on a SuperSpeed link."""
        head = (self.bLength, self.bDescriptorType, self.bEndpointAddress, self.bmAttributes, self.wMaxPacketSize)
        return struct.pack("<BBBBHB", *head, self.bInterval) + bytes(self.extra_descriptors)


@dataclass(frozen=True)
class InterfaceDescriptor:
    """An interface and its endpoints."""

    bInterfaceNumber: int
    bInterfaceProtocol: int
    endpoints: tuple[EndpointDescriptor, ...]
    extra_descriptors: tuple[int, ...] = ()
    bAlternateSetting: int = 0
    bInterfaceClass: int = 0xEF
    bInterfaceSubClass: int = 0x05
    iInterface: int = 0
    bLength: int = 9
    bDescriptorType: int = Kind.INTERFACE

    @property
    def bNumEndpoints(self) -> int:
        return len(self.endpoints)

    def to_bytes(self) -> bytes:
        """As on the wire, with what belongs to it."""
        head = (self.bLength, self.bDescriptorType, self.bInterfaceNumber, self.bAlternateSetting, self.bNumEndpoints)
        kind = (self.bInterfaceClass, self.bInterfaceSubClass, self.bInterfaceProtocol, self.iInterface)
        own = bytes((*head, *kind, *self.extra_descriptors))
        return own + b"".join(endpoint.to_bytes() for endpoint in self.endpoints)


@dataclass(frozen=True)
class ConfigurationDescriptor:
    """The only configuration."""

    interfaces: tuple[InterfaceDescriptor, ...]
    extra_descriptors: tuple[int, ...]
    bMaxPower: int
    bConfigurationValue: int = 1
    iConfiguration: int = 0
    bmAttributes: int = 0x80
    bLength: int = 9
    bDescriptorType: int = Kind.CONFIGURATION

    @property
    def bNumInterfaces(self) -> int:
        return len(self.interfaces)

    @property
    def wTotalLength(self) -> int:
        return len(self.to_bytes())

    def to_bytes(self) -> bytes:
        """As on the wire, with all that it holds."""
        inside = bytes(self.extra_descriptors) + b"".join(interface.to_bytes() for interface in self.interfaces)
        numbers = (self.bNumInterfaces, self.bConfigurationValue, self.iConfiguration, self.bmAttributes)
        total = self.bLength + len(inside)
        return struct.pack("<BBHBBBBB", self.bLength, self.bDescriptorType, total, *numbers, self.bMaxPower) + inside


@dataclass(frozen=True)
class DeviceDescriptor:
    """The device; ``bus`` and what follows is what the host adds."""

    bcdUSB: int
    bMaxPacketSize0: int
    speed: int
    bus: int = 1
    address: int = 1
    port_number: int = 1
    port_numbers: tuple[int, ...] = (1,)
    bDeviceClass: int = 0xEF
    bDeviceSubClass: int = 0x02
    bDeviceProtocol: int = 0x01
    idVendor: int = VENDOR_ID
    idProduct: int = PRODUCT_ID
    bcdDevice: int = 0x0100
    iManufacturer: int = 1
    iProduct: int = 2
    iSerialNumber: int = 3
    bNumConfigurations: int = 1
    bLength: int = 18
    bDescriptorType: int = Kind.DEVICE

    def to_bytes(self) -> bytes:
        """As on the wire."""
        kind = (self.bDeviceClass, self.bDeviceSubClass, self.bDeviceProtocol, self.bMaxPacketSize0)
        numbers = (self.idVendor, self.idProduct, self.bcdDevice)
        strings = (self.iManufacturer, self.iProduct, self.iSerialNumber, self.bNumConfigurations)
        head = (self.bLength, self.bDescriptorType, self.bcdUSB)
        return struct.pack("<BBHBBBBHHHBBBB", *head, *kind, *numbers, *strings)


@dataclass(frozen=True)
class Descriptors:
    """Everything that the device answers to GET_DESCRIPTOR."""

    device: DeviceDescriptor
    configuration: ConfigurationDescriptor
    strings: tuple[str, ...] = field(default=())

    def get(self, kind: int, index: int) -> bytes | None:
        """A descriptor's bytes; None when there is no such."""
        match kind:
            case Kind.DEVICE if index == 0:
                return self.device.to_bytes()
            case Kind.CONFIGURATION if index == 0:
                return self.configuration.to_bytes()
            case Kind.STRING if index == 0:
                return struct.pack("<BBH", 4, Kind.STRING, _ENGLISH)
            case Kind.STRING if index <= len(self.strings):
                text = self.strings[index - 1].encode("utf-16-le")
                return bytes((2 + len(text), Kind.STRING)) + text
            case Kind.BOS if index == 0:
                return _bos()
            case _:
                return None


def descriptors_of(model: CameraModel, speed: Speed, bus: int = 1, address: int = 1) -> Descriptors:
    """The descriptors of a camera on a link."""
    fast = speed is Speed.SUPER
    device = DeviceDescriptor(0x0300 if fast else 0x0210, 9 if fast else 64, int(speed), bus, address)
    strings = (model.vendor, model.model, model.serial, model.guid, model.family, model.version, "simulated")
    return Descriptors(device, _configuration(model, speed), strings)


def _configuration(model: CameraModel, speed: Speed) -> ConfigurationDescriptor:
    def endpoint(address: int) -> EndpointDescriptor:
        companion = (6, Kind.SUPERSPEED_COMPANION, _BURST, 0, 0, 0) if speed is Speed.SUPER else ()
        return EndpointDescriptor(address, speed.packet_size, extra_descriptors=companion)

    kinds = [(0, (CONTROL_OUT, CONTROL_IN)), (1, (EVENT_IN,)), (2, (STREAM_IN,))]
    if not model.event_interface:
        del kinds[1]
    interfaces = tuple(
        InterfaceDescriptor(
            number,
            protocol,
            tuple(endpoint(address) for address in addresses),
            tuple(_device_info()) if protocol == 0 else (),
        )
        for number, (protocol, addresses) in enumerate(kinds)
    )
    association = (8, Kind.INTERFACE_ASSOCIATION, 0, len(interfaces), 0xEF, 0x05, 0x00, 0)
    # bMaxPower counts 8 mA on a SuperSpeed link and 2 mA below.
    return ConfigurationDescriptor(interfaces, association, 112 if speed is Speed.SUPER else 250)


def _device_info() -> bytes:
    """U3V device info: versions of GenCP and U3V, indices of strings, and the speeds that the camera can do."""
    guid, vendor, model, family, version, information, serial, name = 4, 1, 2, 5, 6, 7, 3, 0
    speeds = Speed.HIGH.u3v_bit | Speed.SUPER.u3v_bit
    strings = (guid, vendor, model, family, version, information, serial, name)
    return struct.pack("<BBBHHHH8BB", 20, Kind.U3V_INTERFACE, 1, 1, 1, 0, 1, *strings, speeds)


def _bos() -> bytes:
    """Binary device object store: USB 2.0 extension, and SuperSpeed capability with speeds high and super."""
    extension = struct.pack("<BBBI", 7, Kind.DEVICE_CAPABILITY, 2, 0)
    super_speed = struct.pack("<BBBBHBBH", 10, Kind.DEVICE_CAPABILITY, 3, 0, 0x000C, 2, 0, 0)
    return struct.pack("<BBHB", 5, Kind.BOS, 5 + len(extension) + len(super_speed), 2) + extension + super_speed
