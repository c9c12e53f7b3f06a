"""Ports of Linux's virtual USB host controller, vhci_hcd."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import final

from tests.usb_stack.usbip_server import UsbIpServer
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.model import Speed

CONTROLLER = Path("/sys/devices/platform/vhci_hcd.0")
_DEVICES = Path("/sys/bus/usb/devices")
_FREE, _USED = "004", "006"  # VDEV_ST_NULL, VDEV_ST_USED of the kernel's usbip_common.h
_DEVID = 1 << 16 | 2
_CHANGE_S = 10.0
# enum usb_device_speed of the kernel, and the hub of the controller that has ports of that speed.
_KERNEL_SPEED = {Speed.HIGH: ("hs", 3), Speed.SUPER: ("ss", 5)}


@dataclass(frozen=True)
class Port:
    """A port's line in the controller's status file."""

    hub: str
    number: int
    status: str


def ports() -> tuple[Port, ...]:
    """The controller's ports."""
    lines = (line.split() for line in (CONTROLLER / "status").read_text().splitlines()[1:])
    return tuple(Port(words[0], int(words[1]), words[2]) for words in lines)


@final
class Plug:
    """A camera in a port of the controller: one end of a socket pair is the kernel's, the other the server's."""

    def __init__(self, camera: VirtualCamera) -> None:
        hub, speed = _KERNEL_SPEED[camera.speed]
        self._camera = camera
        self._port = next(port.number for port in ports() if port.hub == hub and port.status == _FREE)
        kernel_end, own_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with kernel_end:
            (CONTROLLER / "attach").write_text(f"{self._port} {kernel_end.fileno()} {_DEVID} {speed}")
        self._server = UsbIpServer(camera, own_end)
        if not _within(_CHANGE_S, lambda: _present(camera.model.serial)):
            raise TimeoutError(f"expected the kernel to find the camera within {_CHANGE_S:.0f} s, found it does not")

    def pull(self) -> None:
        """Unplug the camera and wait until the kernel has seen it."""
        self._camera.unplug()
        if not self._server.join(_CHANGE_S):
            raise TimeoutError("expected the server to end with its camera, found it running")
        if not _within(_CHANGE_S, lambda: self._status() == _FREE and not _present(self._camera.model.serial)):
            raise TimeoutError(f"expected the kernel to let the port go within {_CHANGE_S:.0f} s, found it does not")

    def unconfigure(self) -> None:
        """Take the camera's configuration away, as on a system that has given it none."""
        folder = _folder(self._camera.model.serial)
        assert folder is not None
        (folder / "bConfigurationValue").write_text("-1")

    def _status(self) -> str:
        return next(port.status for port in ports() if port.number == self._port)


PlugIn = Callable[[VirtualCamera], Plug]


def _present(serial: str) -> bool:
    """Whether the kernel has found and configured a device with this serial number."""
    folder = _folder(serial)
    try:
        return folder is not None and (folder / "bConfigurationValue").read_text().strip() == "1"
    except OSError:  # devices may go while one looks
        return False


def _folder(serial: str) -> Path | None:
    """Return the kernel's directory of the device with this serial number; None when it has found none."""
    for folder in _DEVICES.glob("*-*"):
        # Interfaces have no serial number, and devices may go while one looks.
        with contextlib.suppress(OSError):
            if (folder / "serial").read_text().strip() == serial:
                return folder
    return None


def _within(limit_s: float, condition: Callable[[], bool]) -> bool:
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.01)
    return False
