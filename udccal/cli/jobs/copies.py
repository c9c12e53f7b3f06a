"""Packs, unpacks and migrates profiles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import final

from udccal.cli.jobs.apart import check_apart
from udccal.cli.output import Output
from udccal.io.out_folder import storing_in
from udccal.profiles.copies import migrate_profile, pack_profile, unpack_profile
from udccal.profiles.history import identity
from udccal.profiles.store import find_profile


@final
@dataclass(frozen=True)
class WrittenProfile:
    """Result of ``profile pack``, ``unpack`` and ``migrate``; ``sha256`` names the content that was written."""

    source: Path
    written: Path
    version: int
    sha256: str


def pack(output: Output, source: Path, target: Path) -> None:
    """Write a profile as one zip file.

    Args:
        output: says what was written.
        source: folder or zip file of the profile, or a rig's name.
        target: the zip file.

    Raises:
        ProfileError: when the profile cannot be read, or something else is at ``target``.
        UdccalError: when ``target`` cannot be written.
    """
    _write(output, source, target, pack_profile)


def unpack(output: Output, source: Path, target: Path) -> None:
    """Write the profile of a zip file as a folder; arguments and errors are those of ``pack``."""
    _write(output, source, target, unpack_profile)


def migrate(output: Output, source: Path, target: Path) -> None:
    """Write a profile in the present format version; arguments and errors are those of ``pack``.

    Raises:
        ProfileError: when it has the present version already.
    """
    _write(output, source, target, migrate_profile)


def _write(output: Output, source: Path, target: Path, write: Callable[[Path, Path], object]) -> None:
    found = find_profile(source)
    check_apart(target)
    with storing_in(target.parent):
        write(found, target)
        now = identity(target)
    output.say(f"{source} -> {target} (profile {now.sha256[:12]}, format version {now.version})")
    output.result(WrittenProfile(source, target, now.version, now.sha256))
