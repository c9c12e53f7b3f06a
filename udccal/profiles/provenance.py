"""Where a profile's numbers come from."""

from __future__ import annotations

import hashlib
import platform
import sys
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path, PurePath

from udccal import __version__
from udccal.io.hashing import sha256_file
from udccal.profiles.schema import Provenance
from udccal.sessions.schema import StoredCamera

PROFILE_NAME = "profile.json"
MAX_JSON_BYTES = 32 * 1024 * 1024


def provenance_now(session_manifest: Path | None, camera: StoredCamera | None) -> Provenance:
    """Return the provenance of a profile that this process makes now.

    Args:
        session_manifest: ``session.json`` of the session, or None without a session.
        camera: the camera that took the session, or None.
    """
    return Provenance(
        created_at=datetime.now(UTC).isoformat(timespec="seconds"),
        udccal=__version__,
        python=platform.python_version(),
        numpy=metadata.version("numpy"),
        jax=metadata.version("jax"),
        command=portable_command(sys.argv)[:1000],
        session_sha256=None if session_manifest is None else sha256_file(session_manifest),
        camera=camera,
    )


def portable_command(arguments: list[str]) -> str:
    """Return a command line with absolute paths cut to their last name, so that it says nothing about the machine.

    A package that runs as a program, ``python -m package``, is named so. Names that are not text become question marks,
    as ``as_text`` says.
    """
    program, *others = arguments or [""]

    def portable(argument: str) -> str:
        option, equals, value = argument.partition("=")
        if equals and option.startswith("-"):
            return f"{option}={portable(value)}"
        return PurePath(argument).name if Path(argument).is_absolute() else argument

    path = PurePath(program)
    named = f"python -m {path.parent.name}" if path.name == "__main__.py" else portable(program)
    return as_text(" ".join([named, *map(portable, others)]))


def as_text(name: str) -> str:
    """Return a name with question marks for bytes that are not UTF-8, which a file's name may have and JSON may not."""
    return name.encode("utf-8", "replace").decode("utf-8")


def profile_sha256(folder: Path) -> str:
    """Return the SHA-256 of ``profile.json``, which holds all other checksums; a derived profile names it as parent."""
    return hashlib.sha256((folder / PROFILE_NAME).read_bytes()).hexdigest()
