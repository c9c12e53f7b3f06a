"""Checks whether a session fits on its disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from udccal.doctor.finding import Finding, Status
from udccal.doctor.session_size import captured_bytes, session_bytes
from udccal.errors import SessionError
from udccal.rig import RigDescription
from udccal.sessions.changes import check_description
from udccal.sessions.manifest import MANIFEST_NAME, read_manifest
from udccal.sessions.schema import Manifest

_TOPIC = "disk"


def free_bytes(folder: Path) -> int:
    """Return how many bytes this user may still write there."""
    return shutil.disk_usage(folder).free


def disk_finding(session: Path | None, rig: RigDescription | None, free: Callable[[Path], int] = free_bytes) -> Finding:
    """Check whether a folder has room for a session, or for the rest of one; default: the current folder."""
    place = session or Path()
    folder = _nearest_folder(place)
    if folder is None or not os.access(folder, os.W_OK):
        advice = "Choose another folder with --session."
        return Finding(_TOPIC, Status.PROBLEM, f"this user may not write to {folder or place}", advice)
    try:
        manifest = read_manifest(place) if (place / MANIFEST_NAME).is_file() else None
    except SessionError as error:
        return Finding(_TOPIC, Status.PROBLEM, f"the session in {place} cannot be read", str(error))
    try:
        if manifest is not None and rig is not None:
            check_description(place, manifest, rig)
    except SessionError as error:
        found = f"the session in {place} is of another rig, or of one that is described differently"
        return Finding(_TOPIC, Status.PROBLEM, found, str(error))
    described = rig or (manifest.rig if manifest else None)
    available = free(folder)
    found = f"{_size(available)} free in {folder.resolve()}"
    if described is None:
        return Finding(_TOPIC, Status.OK, f"{found}; give --rig and --session to check whether a session fits")
    return _room(found, available, described, manifest)


def _room(found: str, available: int, rig: RigDescription, manifest: Manifest | None) -> Finding:
    whole = session_bytes(rig)
    missing = whole if manifest is None else max(whole - captured_bytes(manifest), 0)
    found += f"; a session of {rig.name} takes at most {_size(whole)}"
    if manifest is not None:
        found += f", of which at most {_size(missing)} are still missing" if missing else ", and is complete"
    if available < missing:
        advice = f"Free {_size(missing - available)} more, or choose a folder on another disk with --session."
        return Finding(_TOPIC, Status.PROBLEM, found, advice)
    return Finding(_TOPIC, Status.OK, found)


def _nearest_folder(path: Path) -> Path | None:
    """Return the folder, or the nearest one above it that exists; None when a file is in the way."""
    while not path.exists() and path != path.parent:
        path = path.parent
    return path if path.is_dir() else None


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e8 else f"{count / 1e6:.1f} MB"
