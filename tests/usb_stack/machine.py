"""A virtual machine: qemu, its serial line, and an end to every wait."""

from __future__ import annotations

import os
import re
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from tests.usb_stack.errors import GuestFailed
from tests.usb_stack.host import QEMU
from tests.usb_stack.initramfs import BOOTED, EXIT, TAG
from tests.usb_stack.serial_line import SerialLine

_MEMORY_MB = "2048"
_PROCESSORS = "2"
_POWER_OFF_S = 20.0
_PASSED = r"\b[1-9][0-9]* passed\b"  # of pytest's last line


@dataclass(frozen=True)
class Accelerator:
    """How the guest's instructions are carried out.

    Attributes:
        boot_s: longest time until the guest says that it has booted.
    """

    name: str
    processor: str
    boot_s: float


KVM = Accelerator("kvm", "host", 15.0)
TCG = Accelerator("tcg", "max", 120.0)  # in software: slow, and runs everywhere


@dataclass(frozen=True)
class Outcome:
    """What a guest came to: its command's exit status, None when it did not get that far, and whether tests passed."""

    booted: bool
    exit_status: int | None
    passed: bool


def run_guest(image: Path, archive: Path, limit_s: float) -> int:
    """Boot, print what the guest says, and return the exit status of its command.

    Raises:
        GuestFailed: when the guest does not boot or end in time, or is content though no test has passed.
    """
    accelerators = [KVM, TCG] if os.access("/dev/kvm", os.R_OK | os.W_OK) else [TCG]
    for accelerator in accelerators:
        print(f"booting the guest with {accelerator.name}", flush=True)
        outcome = _attempt(accelerator, image, archive, limit_s)
        if outcome.exit_status == 0 and not outcome.passed:
            raise GuestFailed("Expected tests to pass in the guest, found none that did. See its last lines above.")
        if outcome.exit_status is not None:
            return outcome.exit_status
        if outcome.booted:
            text = f"Expected the guest to end in {limit_s:.0f} s, found it did not. See its last lines above."
            raise GuestFailed(text)
        print(f"the guest does not boot with {accelerator.name} here", flush=True)
    raise GuestFailed("Expected the guest to boot, found it did not. See its last lines above.")


def _attempt(accelerator: Accelerator, image: Path, archive: Path, limit_s: float) -> Outcome:
    booted, status, passed = False, None, False
    output, input_ = subprocess.PIPE, subprocess.DEVNULL
    command = _command(accelerator, image, archive)
    with subprocess.Popen(command, stdin=input_, stdout=output, stderr=subprocess.STDOUT) as machine:
        assert machine.stdout is not None
        serial = SerialLine(machine.stdout.fileno(), time.monotonic() + accelerator.boot_s)
        try:
            for text in serial.lines():
                print(text, flush=True)
                passed = passed or re.search(_PASSED, text) is not None
                if text.startswith(BOOTED):
                    booted, serial.deadline_s = True, time.monotonic() + limit_s
                elif text.startswith(EXIT):
                    status, serial.deadline_s = int(text.split()[-1]), time.monotonic() + _POWER_OFF_S
        finally:
            machine.kill()
    return Outcome(booted, status, passed)


def _command(accelerator: Accelerator, image: Path, archive: Path) -> tuple[str, ...]:
    shared = f"local,path=/,mount_tag={TAG},security_model=none,readonly=on,multidevs=remap"
    machine = ("-machine", "q35", "-accel", accelerator.name, "-cpu", accelerator.processor, "-smp", _PROCESSORS)
    boot = ("-kernel", str(image), "-initrd", str(archive), "-append", "console=ttyS0 quiet panic=-1 edd=off")
    bare = ("-nodefaults", "-no-user-config", "-no-reboot", "-display", "none", "-serial", "stdio", "-m", _MEMORY_MB)
    return (QEMU, *machine, *bare, *boot, "-virtfs", shared)
