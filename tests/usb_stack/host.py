"""What this machine must have before a kernel is fetched and booted."""

from __future__ import annotations

import platform
import shutil
import struct
from pathlib import Path

from tests.usb_stack.errors import CannotRun

QEMU = "qemu-system-x86_64"
_BUSYBOX = "busybox"
_PACKAGES = {QEMU: "qemu-system-x86", _BUSYBOX: "busybox-static", "arv-tool-0.8": "aravis-tools-cli"}
_INTERPRETER = 3  # PT_INTERP of the ELF's program headers: the loader of a program that needs libraries


def check_host() -> None:
    """Whether the guest could boot here and run its tests.

    Raises:
        CannotRun: when it could not.
    """
    if platform.machine() != "x86_64":
        text = "Expected an x86_64 machine, whose own files the guest runs, found {}. Run this on one."
        raise CannotRun(text.format(platform.machine()))
    absent = [program for program in _PACKAGES if shutil.which(program) is None]
    if absent:
        packages = " ".join(_PACKAGES[program] for program in absent)
        raise CannotRun(f"Expected {', '.join(absent)}, found none. Install them: apt-get install {packages}.")
    if not _is_static(busybox().read_bytes()):
        raise CannotRun("Expected a static busybox, found one that needs libraries. Install busybox-static.")


def busybox() -> Path:
    """The busybox of a machine that has been checked."""
    found = shutil.which(_BUSYBOX)
    assert found is not None
    return Path(found)


def _is_static(program: bytes) -> bool:
    """Whether a 64-bit ELF program runs without a loader (System V ABI, chapters 4 and 5)."""
    if program[:5] != b"\x7fELF\x02":
        return False
    (headers,) = struct.unpack_from("<Q", program, 32)
    size, count = struct.unpack_from("<HH", program, 54)
    kinds = [struct.unpack_from("<I", program, headers + index * size)[0] for index in range(count)]
    return _INTERPRETER not in kinds
