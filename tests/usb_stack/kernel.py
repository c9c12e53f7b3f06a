"""Debian's stock kernel: found by apt, and the few files of it that the guest needs."""

from __future__ import annotations

import lzma
import os
import re
import shutil
import subprocess
import tarfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.usb_stack.errors import CannotRun

MODULES = ("virtio_pci", "9pnet_virtio", "9p", "overlay", "vhci_hcd")
_APT_S = 300
_META_PACKAGE = "linux-image-amd64"
_NEEDS_DEBIAN = (
    "Expected Debian's apt-get, apt-cache and dpkg-deb, which fetch the guest's kernel, found no {name}. "
    "Run this on Debian or Ubuntu, or unpack a Debian kernel package into {cache} yourself."
)


@dataclass(frozen=True)
class Kernel:
    """A kernel on disk.

    Attributes:
        image: that a machine boots.
        modules: in the order in which they are loaded.
    """

    image: Path
    modules: tuple[Path, ...]


def kernel_in(cache: Path) -> Kernel:
    """The kernel in the cache folder, fetched first when there is none.

    Raises:
        CannotRun: when there is none and it cannot be fetched.
    """
    if not (cache / "kernel" / "vmlinuz").exists():
        _fetch(cache)
    folder = cache / "kernel"
    return Kernel(folder / "vmlinuz", tuple(_in_loading_order(folder)))


def _fetch(cache: Path) -> None:
    for tool in ("apt-get", "apt-cache", "dpkg-deb"):
        if shutil.which(tool) is None:
            raise CannotRun(_NEEDS_DEBIAN.format(name=tool, cache=cache))
    cache.mkdir(exist_ok=True)
    package = _package_name()
    print(f"fetching {package} into {cache} (about 70 MB, once)", flush=True)
    _run(("apt-get", "download", "-q", package), cache)
    archive = max(cache.glob(f"{package}_*.deb"), key=lambda path: path.stat().st_mtime)
    partial = cache / "kernel.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    _unpack(archive, partial)
    os.replace(partial, cache / "kernel")
    archive.unlink()


def _package_name() -> str:
    found = re.search(r"Depends:\s*(linux-image-[\w.+-]+)", _run(("apt-cache", "depends", _META_PACKAGE), None))
    if found is None:
        raise CannotRun(f"Expected apt to know {_META_PACKAGE}, found it does not. Run 'apt-get update' and try again.")
    return found.group(1)


def _run(command: tuple[str, ...], folder: Path | None) -> str:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=_APT_S, check=True)
    except subprocess.TimeoutExpired as reason:
        text = f"Expected '{' '.join(command)}' to end in {_APT_S} s, found it did not. Try again."
        raise CannotRun(text) from reason
    except subprocess.CalledProcessError as reason:
        last = reason.stderr.strip().splitlines()[-1:] or ["no message"]
        text = f"Expected '{' '.join(command)}' to succeed, found: {last[0]} Run 'apt-get update' and try again."
        raise CannotRun(text) from reason
    return done.stdout


def _unpack(archive: Path, folder: Path) -> None:
    """The kernel's image and the modules that those in MODULES need; every other file is passed over."""
    unpacker = subprocess.Popen(("dpkg-deb", "--fsys-tarfile", str(archive)), stdout=subprocess.PIPE)
    with unpacker, tarfile.open(fileobj=unpacker.stdout, mode="r|") as content:
        for member in content:
            name, file = member.name.rsplit("/", 1)[-1], content.extractfile(member) if member.isfile() else None
            if file is not None and (name.startswith("vmlinuz-") or re.fullmatch(r".+\.ko(\.xz)?", name)):
                _keep(folder, name, file.read())
    wanted = {path.name for path in _in_loading_order(folder)}
    for path in folder.glob("*.ko"):
        if path.name not in wanted:
            path.unlink()


def _keep(folder: Path, name: str, data: bytes) -> None:
    if name.startswith("vmlinuz-"):
        (folder / "vmlinuz").write_bytes(data)
    else:
        stem = name.split(".", 1)[0].replace("-", "_")
        (folder / f"{stem}.ko").write_bytes(lzma.decompress(data) if name.endswith(".xz") else data)


def _in_loading_order(folder: Path) -> Iterable[Path]:
    """MODULES and what they depend on, as their own ``depends=`` says, dependencies first."""
    order: list[str] = []

    def visit(name: str) -> None:
        path = folder / f"{name}.ko"
        if name in order or not path.exists():  # built into the kernel
            return
        said = re.search(rb"\0depends=([^\0]*)\0", path.read_bytes())
        for other in said.group(1).decode().split(",") if said else ():
            if other:
                visit(other.replace("-", "_"))
        order.append(name)

    for module in MODULES:
        visit(module)
    return (folder / f"{name}.ko" for name in order)
