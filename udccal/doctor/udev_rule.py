"""The udev rule that lets people open USB3 Vision cameras on Linux."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

RULE_FILE: Final = Path("etc/udev/rules.d/70-udccal-cameras.rules")
_BASLER: Final = 0x2676
# The control interface (class EF, subclass 05, protocol 00) identifies USB3 Vision, not the device. A rule for the
# device sees the list of its interfaces that udev's usb_id makes, each between colons.
_ANY_MAKER: Final = (
    'SUBSYSTEM=="usb", ENV{DEVTYPE}=="usb_device", ENV{ID_USB_INTERFACES}=="*:ef0500:*", MODE="0666", TAG+="uaccess"'
)


def udev_rule(vendor_ids: Iterable[int] = ()) -> str:
    """Return the rule: one line for every maker, then, should it not match, lines for Basler and the given vendors."""
    vendors = sorted({_BASLER, *vendor_ids})
    by_vendor = (
        f'SUBSYSTEM=="usb", ENV{{DEVTYPE}}=="usb_device", ATTR{{idVendor}}=="{vendor:04x}", MODE="0666", TAG+="uaccess"'
        for vendor in vendors
    )
    return "\n".join(("# USB3 Vision cameras may be opened by everyone at this computer.", _ANY_MAKER, *by_vendor, ""))


def install_commands(vendor_ids: Iterable[int] = ()) -> str:
    """Return the commands that install the rule and make the system apply it."""
    return (
        f"sudo tee /{RULE_FILE} <<'END'\n{udev_rule(vendor_ids)}END\n"
        "sudo udevadm control --reload-rules\n"
        "sudo udevadm trigger --subsystem-match=usb"
    )
