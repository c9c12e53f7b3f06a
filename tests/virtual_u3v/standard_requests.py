"""Endpoint 0: the standard requests of USB 2.0 §9.4 and USB 3.x §9.4, as far as a camera answers them."""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass
from typing import final

from tests.virtual_u3v.descriptors import Descriptors
from tests.virtual_u3v.usb_faults import Stalled

_OTHER_TYPES, _FROM_DEVICE = 0x60, 0x80
_TO_DEVICE, _TO_INTERFACE, _TO_ENDPOINT = 0, 1, 2
_ENDPOINT_HALT = 0


class Request(enum.IntEnum):
    """Standard requests by number (USB 3.x, table 9-5)."""

    GET_STATUS = 0
    CLEAR_FEATURE = 1
    SET_FEATURE = 3
    GET_DESCRIPTOR = 6
    GET_CONFIGURATION = 8
    SET_CONFIGURATION = 9
    GET_INTERFACE = 10
    SET_INTERFACE = 11
    SET_SEL = 48
    SET_ISOCH_DELAY = 49


@dataclass(frozen=True)
class Setup:
    """A setup packet."""

    bmRequestType: int
    bRequest: int
    wValue: int
    wIndex: int
    wLength: int

    @staticmethod
    def from_bytes(data: bytes) -> Setup:
        """From its 8 bytes."""
        return Setup(*struct.unpack("<BBHHH", data))


@final
class DefaultPipe:
    """What endpoint 0 knows: the configuration chosen and which endpoints are halted."""

    def __init__(self, descriptors: Descriptors) -> None:
        self._descriptors = descriptors
        self.configuration = 0
        self.halted: set[int] = set()

    def request(self, setup: Setup) -> bytes:
        """Answer of the device, empty for requests without data; Stalled for those that it does not know."""
        if setup.bmRequestType & _OTHER_TYPES:  # neither class nor vendor requests
            raise Stalled("no such request")
        if setup.bmRequestType & _FROM_DEVICE:
            return self._get(setup)[: setup.wLength]
        self._set(setup)
        return b""

    def _get(self, setup: Setup) -> bytes:
        match setup.bRequest:
            case Request.GET_DESCRIPTOR:
                descriptor = self._descriptors.get(setup.wValue >> 8, setup.wValue & 0xFF)
                if descriptor is not None:
                    return descriptor
            case Request.GET_STATUS:
                halted = setup.bmRequestType & 0x1F == _TO_ENDPOINT and setup.wIndex in self.halted
                return struct.pack("<H", int(halted))
            case Request.GET_CONFIGURATION:
                return bytes((self.configuration,))
            case Request.GET_INTERFACE:
                return b"\0"
        raise Stalled("no such request")

    def _set(self, setup: Setup) -> None:
        recipient = setup.bmRequestType & 0x1F
        match setup.bRequest:
            case Request.SET_CONFIGURATION if setup.wValue <= 1:
                self.configuration = setup.wValue
                self.halted.clear()
            case Request.SET_INTERFACE if setup.wValue == 0:
                self.halted.clear()
            case Request.CLEAR_FEATURE if recipient == _TO_ENDPOINT and setup.wValue == _ENDPOINT_HALT:
                self.halted.discard(setup.wIndex)
            case Request.SET_FEATURE if recipient == _TO_ENDPOINT and setup.wValue == _ENDPOINT_HALT:
                self.halted.add(setup.wIndex)
            case Request.CLEAR_FEATURE | Request.SET_FEATURE if recipient in (_TO_DEVICE, _TO_INTERFACE):
                pass  # power saving of the link, which a camera without a battery does not do
            case Request.SET_SEL | Request.SET_ISOCH_DELAY:
                pass  # delays of the link, of use to isochronous endpoints only
            case _:
                raise Stalled("no such request")
