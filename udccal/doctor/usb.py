"""Checks speed, permission and memory of USB."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from udccal.doctor.finding import Finding, Status
from udccal.doctor.machine import Machine
from udccal.doctor.udev_rule import RULE_FILE, install_commands
from udccal.doctor.usb_bus import BusCamera, bus_cameras, has_usb

_MEMORY: Final = Path("sys/module/usbcore/parameters/usbfs_memory_mb")
_ADVISED_MB: Final = 1000
_SUPER_SPEED_MBIT: Final = 5000
_LINUX_ONLY: Final = "linux"


def usb_findings(machine: Machine) -> tuple[Finding, ...]:
    """Return what the Linux kernel reports about cameras on USB; nothing on other systems, which do not report it."""
    if not machine.system.startswith(_LINUX_ONLY):
        return ()
    if not has_usb(machine):
        advice = "In a virtual machine or container, pass the USB controller through to it."
        return (Finding("USB", Status.NOTE, "this computer shows no USB", advice),)
    cameras = bus_cameras(machine)
    return (speed_finding(cameras), permission_finding(machine, cameras), memory_finding(machine))


def speed_finding(cameras: Sequence[BusCamera]) -> Finding:
    """Check whether each camera runs at SuperSpeed, which every USB3 Vision camera supports."""
    topic = "USB speed"
    if not cameras:
        return Finding(topic, Status.NOTE, "no USB3 Vision camera is plugged in")
    found = "; ".join(f"{camera.name}: {_speed(camera)}" for camera in cameras)
    if any(0 < camera.mbit_per_s < _SUPER_SPEED_MBIT for camera in cameras):
        advice = (
            "The camera runs, but at a tenth of its frame rate or less: it is plugged into a USB 2 port or cable. Plug "
            "it straight into a USB 3 port of the computer (blue, or marked SS), without a hub, with a USB 3 cable of "
            "at most 3 m."
        )
        return Finding(topic, Status.NOTE, found, advice)
    return Finding(topic, Status.OK, found)


def permission_finding(machine: Machine, cameras: Sequence[BusCamera]) -> Finding:
    """Check whether this user may open each camera; every camera that is plugged in counts as asked for."""
    topic = "USB permission"
    refused = [camera for camera in cameras if not machine.may_open(camera.node)]
    if any(not camera.node.exists() for camera in refused):
        found = f"no device file for {_names(refused)}"
        advice = "In a container, pass /dev/bus/usb through to it. Otherwise plug the camera in again."
        return Finding(topic, Status.PROBLEM, found, advice)
    vendors = [camera.vendor_id for camera in cameras]
    install = f"Install this udev rule, then plug the camera in again:\n{install_commands(vendors)}"
    if refused:
        return Finding(topic, Status.PROBLEM, f"this user may not open {_names(refused)}", install)
    if cameras:
        return Finding(topic, Status.OK, f"this user may open {_names(cameras)}")
    if (machine.root / RULE_FILE).is_file():
        return Finding(topic, Status.OK, "udccal's udev rule is installed")
    return Finding(topic, Status.NOTE, "no camera to try, and udccal's udev rule is not installed", install)


def memory_finding(machine: Machine) -> Finding:
    """Check how much memory the kernel allows for USB transfers of programs."""
    topic = "USB memory"
    text = machine.value(machine.root / _MEMORY) or ""
    if not re.fullmatch(r"[0-9]{1,9}", text):
        found = f"{_MEMORY.name} holds '{text[:20]}'" if text else f"the kernel shows no {_MEMORY.name}"
        return Finding(topic, Status.NOTE, found, "Nothing to do as long as frames arrive.")
    megabytes = int(text)
    if megabytes == 0 or megabytes >= _ADVISED_MB:
        return Finding(topic, Status.OK, f"{megabytes} MB" if megabytes else "without limit")
    advice = (
        f"This is enough for one slow camera. These commands set {_ADVISED_MB} MB, now and at every later start:\n"
        f"echo {_ADVISED_MB} | sudo tee /{_MEMORY}\n"
        f"echo 'w /{_MEMORY} - - - - {_ADVISED_MB}' | sudo tee /etc/tmpfiles.d/udccal.conf"
    )
    return Finding(topic, Status.NOTE, f"{megabytes} MB", advice)


def _speed(camera: BusCamera) -> str:
    if not camera.mbit_per_s:
        return "speed not known"
    name = "SuperSpeed" if camera.mbit_per_s >= _SUPER_SPEED_MBIT else "USB 2 speed"
    return f"{camera.mbit_per_s:g} Mbit/s, {name}"


def _names(cameras: Sequence[BusCamera]) -> str:
    return ", ".join(camera.name for camera in cameras)
