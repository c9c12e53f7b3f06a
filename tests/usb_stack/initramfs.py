"""The guest's first files: busybox, kernel modules, and the script that makes the host's root its own."""

from __future__ import annotations

import shlex
from pathlib import Path

from tests.usb_stack.kernel import Kernel

BOOTED = "usb-stack-guest: booted after"
EXIT = "usb-stack-guest: exit status"
TAG = "root"
_FILE, _FOLDER, _DEVICE = 0o100755, 0o040755, 0o020600
# The root is the host's, read-only, under a file system in memory: the guest sees this very environment and leaves no
# trace. The clock of the host is not the guest's before the first line of output, so boot time is the guest's uptime.
_INIT = """#!/bin/busybox sh
export PATH=/bin
/bin/busybox --install -s /bin
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
for module in {modules}; do insmod /modules/$module || echo "cannot load $module"; done
mount -t 9p -o ro,trans=virtio,version=9p2000.L,cache=loose,msize=524288 {tag} /host || echo "cannot mount the host"
mount -t tmpfs tmpfs /scratch
mkdir /scratch/upper /scratch/work
mount -t overlay -o lowerdir=/host,upperdir=/scratch/upper,workdir=/scratch/work overlay /root
for place in proc sys dev; do mount --move /$place /root/$place; done
mkdir -p /root/dev/shm /root/dev/pts
mount -t tmpfs shm /root/dev/shm
mount -t devpts pts /root/dev/pts
read uptime rest < /root/proc/uptime
echo "{booted} $uptime s"
ip link set lo up
chroot /root /bin/sh -c {command}
echo "{exit} $?"
poweroff -f
"""


def initramfs(kernel: Kernel, busybox: Path, command: str) -> bytes:
    """An archive that loads the kernel's modules, runs ``command`` as root in the host's files, and powers off."""
    names = " ".join(path.name for path in kernel.modules)
    script = _INIT.format(modules=names, tag=TAG, booted=BOOTED, exit=EXIT, command=shlex.quote(command))
    folders = ("bin", "dev", "proc", "sys", "host", "scratch", "root", "modules")
    entries = [_entry(folder, _FOLDER, b"") for folder in folders]
    entries.append(_entry("dev/console", _DEVICE, b"", device=(5, 1)))
    entries.append(_entry("bin/busybox", _FILE, busybox.read_bytes()))
    entries += [_entry(f"modules/{path.name}", _FILE, path.read_bytes()) for path in kernel.modules]
    entries.append(_entry("init", _FILE, script.encode()))
    entries.append(_entry("TRAILER!!!", 0, b""))
    return b"".join(entries)


def _entry(name: str, mode: int, data: bytes, device: tuple[int, int] = (0, 0)) -> bytes:
    """One member of a cpio archive in the "new ASCII" format, which the kernel unpacks."""
    numbers = (0, mode, 0, 0, 1, 0, len(data), 0, 0, *device, len(name) + 1, 0)
    head = b"070701" + b"".join(b"%08X" % number for number in numbers) + name.encode() + b"\0"
    return _padded(head) + _padded(data)


def _padded(data: bytes) -> bytes:
    return data + b"\0" * (-len(data) % 4)
