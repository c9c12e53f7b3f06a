"""Virtual cameras as a pyusb backend: libusb's functions, lengths and errors, without libusb and without waiting."""

from __future__ import annotations

import errno
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import final

import usb.backend
from usb.core import USBError, USBTimeoutError

from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.descriptors import (
    ConfigurationDescriptor,
    DeviceDescriptor,
    EndpointDescriptor,
    InterfaceDescriptor,
)
from tests.virtual_u3v.standard_requests import Request, Setup
from tests.virtual_u3v.usb_faults import Overflowed, Stalled, Unplugged

_MS = 1_000_000
_HALT_REQUEST = 0x02
_GET_CONFIGURATION = Setup(0x80, Request.GET_CONFIGURATION, 0, 0, 1)
_CONFIGURE = Setup(0x00, Request.SET_CONFIGURATION, 1, 0, 0)
_NO_DEVICE, _NOT_FOUND, _BUSY, _TIMEOUT, _OVERFLOW, _PIPE, _ACCESS = -4, -5, -6, -7, -8, -9, -3
# libusb's own texts and errno, as pyusb's libusb1 backend reports them.
_ERRORS = {
    _ACCESS: ("Access denied (insufficient permissions)", errno.EACCES),
    _NO_DEVICE: ("No such device (it may have been disconnected)", errno.ENODEV),
    _NOT_FOUND: ("Entity not found", errno.ENOENT),
    _BUSY: ("Resource busy", errno.EBUSY),
    _OVERFLOW: ("Overflow", errno.EOVERFLOW),
    _PIPE: ("Pipe error", errno.EPIPE),
}


@dataclass(eq=False)
class _Handle:
    """An open device: the plugging-in it belongs to, and the interfaces it holds."""

    camera: VirtualCamera
    address: int
    claimed: set[int] = field(default_factory=set)


@dataclass(frozen=True)
class _Device:
    camera: VirtualCamera
    address: int


@final
class VirtualBackend(usb.backend.IBackend):
    """A host with virtual cameras at its ports."""

    def __init__(self, cameras: Sequence[VirtualCamera]) -> None:
        super().__init__()
        self._cameras = tuple(cameras)
        self._handles: list[_Handle] = []

    def enumerate_devices(self) -> Iterator[_Device]:
        present = [camera for camera in self._cameras if camera.plugged]
        for camera in present:
            # Linux does this when a device is plugged in; a host program finds it done.
            if not camera.faults.unconfigured and camera.control(_GET_CONFIGURATION) == b"\0":
                camera.control(_CONFIGURE)
        return iter([_Device(camera, camera.address) for camera in present])

    def get_parent(self, dev: _Device) -> None:
        return None

    def get_device_descriptor(self, dev: _Device) -> DeviceDescriptor:
        return dev.camera.descriptors.device

    def get_configuration_descriptor(self, dev: _Device, config: int) -> ConfigurationDescriptor:
        if config:
            raise IndexError(f"Invalid configuration index {config}")
        return dev.camera.descriptors.configuration

    def get_interface_descriptor(self, dev: _Device, intf: int, alt: int, config: int) -> InterfaceDescriptor:
        if alt:
            raise IndexError(f"Invalid alternate setting index {alt}")
        return self.get_configuration_descriptor(dev, config).interfaces[intf]

    def get_endpoint_descriptor(self, dev: _Device, ep: int, intf: int, alt: int, config: int) -> EndpointDescriptor:
        return self.get_interface_descriptor(dev, intf, alt, config).endpoints[ep]

    def open_device(self, dev: _Device) -> _Handle:
        if dev.camera.faults.access_denied:
            raise _error(_ACCESS)
        handle = _Handle(dev.camera, dev.address)
        self._check_present(handle)
        self._handles.append(handle)
        return handle

    def close_device(self, dev_handle: _Handle) -> None:
        self._handles.remove(dev_handle)

    def set_configuration(self, dev_handle: _Handle, config_value: int) -> None:
        if any(handle.claimed for handle in self._handles if handle.camera is dev_handle.camera):
            raise _error(_BUSY)
        self._request(dev_handle, Setup(0x00, Request.SET_CONFIGURATION, config_value, 0, 0))

    def get_configuration(self, dev_handle: _Handle) -> int:
        return self._request(dev_handle, _GET_CONFIGURATION)[0]

    def set_interface_altsetting(self, dev_handle: _Handle, intf: int, altsetting: int) -> None:
        self._check_claimed(dev_handle, intf)
        self._request(dev_handle, Setup(0x01, Request.SET_INTERFACE, altsetting, intf, 0))

    def claim_interface(self, dev_handle: _Handle, intf: int) -> None:
        self._check_present(dev_handle)
        same = [h for h in self._handles if h.camera is dev_handle.camera and h.address == dev_handle.address]
        others = [handle for handle in same if handle is not dev_handle]
        if dev_handle.camera.faults.interface_busy or any(intf in handle.claimed for handle in others):
            raise _error(_BUSY)
        configured = self.get_configuration(dev_handle) == 1
        if not configured or intf >= dev_handle.camera.descriptors.configuration.bNumInterfaces:
            raise _error(_NOT_FOUND)
        dev_handle.claimed.add(intf)

    def release_interface(self, dev_handle: _Handle, intf: int) -> None:
        self._check_present(dev_handle)
        self._check_claimed(dev_handle, intf)
        dev_handle.claimed.remove(intf)

    def bulk_write(self, dev_handle: _Handle, ep: int, intf: int, data: array[int], timeout: int) -> int:
        self._check_present(dev_handle)
        self._check_claimed(dev_handle, intf)
        with _errors():
            dev_handle.camera.bulk_out(ep, data.tobytes())
        return len(data) * data.itemsize

    def bulk_read(self, dev_handle: _Handle, ep: int, intf: int, buff: array[int], timeout: int) -> int:
        self._check_claimed(dev_handle, intf)
        deadline_ns = dev_handle.camera.clock.now_ns() + timeout * _MS
        while True:
            self._check_present(dev_handle)
            with _errors():
                data = dev_handle.camera.bulk_in(ep, len(buff) * buff.itemsize)
            if data is not None:
                memoryview(buff).cast("B")[: len(data)] = data
                return len(data)
            self._wait(dev_handle.camera, ep, deadline_ns, endless=timeout == 0)

    def ctrl_transfer(
        self,
        dev_handle: _Handle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array[int],
        timeout: int,
    ) -> int:
        length = len(data) * data.itemsize
        answer = self._request(dev_handle, Setup(bmRequestType, bRequest, wValue, wIndex, length))
        if not bmRequestType & 0x80:
            return length
        memoryview(data).cast("B")[: len(answer)] = answer
        return len(answer)

    def clear_halt(self, dev_handle: _Handle, ep: int) -> None:
        self._request(dev_handle, Setup(_HALT_REQUEST, Request.CLEAR_FEATURE, 0, ep, 0))

    def reset_device(self, dev_handle: _Handle) -> None:
        self._request(dev_handle, _CONFIGURE)

    def is_kernel_driver_active(self, dev_handle: _Handle, intf: int) -> bool:
        return False

    def _request(self, handle: _Handle, setup: Setup) -> bytes:
        self._check_present(handle)
        with _errors():
            return handle.camera.control(setup)

    def _wait(self, camera: VirtualCamera, endpoint: int, deadline_ns: int, endless: bool) -> None:
        """Let time pass until the camera has something, or until the deadline, which ends the transfer."""
        with _errors():
            ready_ns = camera.ready_ns(endpoint)
        now_ns = camera.clock.now_ns()
        if ready_ns is not None and (endless or ready_ns <= deadline_ns):
            camera.clock.wait_ns(ready_ns - now_ns)
        elif endless:
            raise RuntimeError("Expected a time-out or something to wait for, found neither: this read never ends.")
        else:
            camera.clock.wait_ns(deadline_ns - now_ns)
            raise USBTimeoutError("Operation timed out", _TIMEOUT, errno.ETIMEDOUT)

    def _check_present(self, handle: _Handle) -> None:
        if not handle.camera.plugged or handle.camera.address != handle.address:
            raise _error(_NO_DEVICE)

    def _check_claimed(self, handle: _Handle, interface: int) -> None:
        if interface not in handle.claimed:
            raise _error(_NOT_FOUND)


def _error(code: int) -> USBError:
    text, number = _ERRORS[code]
    return USBError(text, code, number)


@contextmanager
def _errors() -> Iterator[None]:
    try:
        yield
    except Stalled as reason:
        raise _error(_PIPE) from reason
    except Overflowed as reason:
        raise _error(_OVERFLOW) from reason
    except Unplugged as reason:
        raise _error(_NO_DEVICE) from reason
