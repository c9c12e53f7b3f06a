"""Small made-up trees of /sys and /dev."""

from __future__ import annotations

from pathlib import Path

BASLER = {
    "idVendor": "2676",
    "idProduct": "ba02",
    "manufacturer": "Basler",
    "product": "acA2040-120uc",
    "serial": "23456789",
    "speed": "5000",
    "version": " 3.00",
    "busnum": "2",
    "devnum": "7",
}
CONTROL = {"bInterfaceClass": "ef", "bInterfaceSubClass": "05", "bInterfaceProtocol": "00"}
STREAM = CONTROL | {"bInterfaceProtocol": "02"}
DISK = {"bInterfaceClass": "08", "bInterfaceSubClass": "06", "bInterfaceProtocol": "50"}


def write_values(folder: Path, values: dict[str, str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, value in values.items():
        (folder / name).write_text(f"{value}\n", encoding="utf-8")


def add_device(root: Path, port: str, values: dict[str, str], *interfaces: dict[str, str]) -> Path:
    """A device with its interfaces, linked into the bus as the kernel does; returns its device file."""
    bus, devices = root / "sys/bus/usb/devices", root / "sys/devices/pci0000:00/usb"
    bus.mkdir(parents=True, exist_ok=True)
    write_values(devices / port, values)
    (bus / port).symlink_to(devices / port)
    for number, interface in enumerate(interfaces):
        name = f"{port}:1.{number}"
        write_values(devices / port / name, interface)
        (bus / name).symlink_to(devices / port / name)
    node = root / f"dev/bus/usb/{int(values['busnum']):03}/{int(values['devnum']):03}"
    node.parent.mkdir(parents=True, exist_ok=True)
    node.write_bytes(b"")
    return node


def set_usb_memory(root: Path, text: str) -> None:
    write_values(root / "sys/module/usbcore/parameters", {"usbfs_memory_mb": text})
