"""Lists USB3 Vision cameras from the Linux kernel, without a driver or library."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from udccal.doctor.machine import Machine

_DEVICES: Final = Path("sys/bus/usb/devices")
_NODES: Final = Path("dev/bus/usb")
# Interface class, subclass and protocol of a control interface (USB3 Vision 1.1, 3.2).
_CONTROL: Final = (0xEF, 0x05, 0x00)
_MOST_ENTRIES: Final = 4096
_MOST_NUMBER: Final = 999  # a device node's name has three digits


@final
@dataclass(frozen=True)
class BusCamera:
    """A camera at a port of this computer.

    Attributes:
        name: maker, model and serial, as far as the camera gives them.
        vendor_id: USB's number of the maker.
        mbit_per_s: speed of the link; 0 when not known.
        node: the device file that a program opens.
    """

    name: str
    vendor_id: int
    mbit_per_s: float
    node: Path


def has_usb(machine: Machine) -> bool:
    """Return whether the kernel has USB at all; virtual machines and containers often do not."""
    return (machine.root / _DEVICES).is_dir()


def bus_cameras(machine: Machine) -> tuple[BusCamera, ...]:
    """Return every device with a USB3 Vision control interface; skip invalid entries."""
    folder = machine.root / _DEVICES
    try:
        entries = sorted(entry.name for entry in itertools.islice(folder.iterdir(), _MOST_ENTRIES))
    except OSError:
        return ()
    # Interfaces are listed next to their device and named after it: 2-1:1.0 belongs to 2-1.
    devices = {name.partition(":")[0] for name in entries if ":" in name and _is_control(machine, folder / name)}
    cameras = (_camera(machine, folder / name) for name in sorted(devices))
    return tuple(camera for camera in cameras if camera is not None)


def _is_control(machine: Machine, folder: Path) -> bool:
    names = ("bInterfaceClass", "bInterfaceSubClass", "bInterfaceProtocol")
    return tuple(_number(machine, folder / name, 16) for name in names) == _CONTROL


def _camera(machine: Machine, folder: Path) -> BusCamera | None:
    vendor = _number(machine, folder / "idVendor", 16)
    bus, device = (_number(machine, folder / name, 10) for name in ("busnum", "devnum"))
    if vendor is None or bus is None or device is None or max(bus, device) > _MOST_NUMBER:
        return None
    texts = (machine.value(folder / name) for name in ("manufacturer", "product", "serial"))
    name = " ".join(text[:100] for text in texts if text) or f"camera of vendor {vendor:04x}"
    return BusCamera(name, vendor, _speed(machine, folder), machine.root / _NODES / f"{bus:03}" / f"{device:03}")


def _speed(machine: Machine, folder: Path) -> float:
    """Return the speed in Mbit/s from the stable kernel interface ``/sys/bus/usb/devices/.../speed``: 480, 5000, ..."""
    text = machine.value(folder / "speed") or ""
    return float(text) if re.fullmatch(r"[0-9]{1,6}(\.[0-9])?", text) else 0.0


def _number(machine: Machine, path: Path, base: int) -> int | None:
    text = machine.value(path) or ""
    try:
        number = int(text, base)
    except ValueError:
        return None
    return number if 0 <= number <= 0xFFFF else None
