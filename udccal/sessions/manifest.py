"""Reading and writing ``session.json``: strict, bounded, atomic, and refused with a sentence."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import ValidationError

from udccal.errors import SessionError
from udccal.io.atomic import write_atomically
from udccal.sessions.schema import Manifest

MANIFEST_NAME = "session.json"
FORMAT = "udccal-session"
VERSION = 1
_MAX_BYTES = 64 * 1024 * 1024


def read_manifest(folder: Path) -> Manifest:
    """Read and check the manifest of a session.

    Raises:
        SessionError: when it is missing, too large, not JSON, of a newer version, or does not follow docs/session.md.
    """
    file = folder / MANIFEST_NAME
    if not file.is_file():
        raise SessionError(
            f"Expected a session with a {MANIFEST_NAME} at {folder}, found none. Check the path, or capture a session."
        )
    size = file.stat().st_size
    if size > _MAX_BYTES:
        raise SessionError(f"Expected {file} to hold at most {_MAX_BYTES} bytes, found {size}. It is not a manifest.")
    content = file.read_bytes()
    _check_version(file, content)
    try:
        return Manifest.model_validate_json(content, strict=True)
    except ValidationError as error:
        raise SessionError(_sentence(file, error)) from error


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Replace the manifest whole: a reader meets the old one or the new one, never half of either."""
    write_atomically(folder / MANIFEST_NAME, manifest.model_dump_json(indent=1).encode() + b"\n")


def _check_version(file: Path, content: bytes) -> None:
    """Refuse other formats and newer versions before the strict reading, which would only name an unknown entry."""
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise SessionError(f"Expected {file} to be JSON, found: {error}. Restore it from a copy.") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise SessionError(f"Expected {file} to have the format '{FORMAT}', found another. Check the path.")
    version = found.get("version")
    if isinstance(version, int) and version > VERSION:
        raise SessionError(
            f"Expected {file} to have version {VERSION}, found the newer version {version}. Update udccal to read it."
        )


def _sentence(file: Path, error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"]) or "the manifest"
    if first["type"] == "missing":
        return f"Expected an entry '{where}' in {file}, found none. Add it as docs/session.md says."
    if first["type"] == "extra_forbidden":
        return f"Expected only the entries of docs/session.md in {file}, found '{where}'. Remove it."
    if first["type"] == "value_error":
        return f"Expected in {where} of {file} {first['ctx']['error']}. Correct it as docs/session.md says."
    found = repr(first["input"])
    shown = found if len(found) <= 60 else found[:57] + "..."
    return f"Expected a valid '{where}' in {file} ({first['msg']}), found {shown}. Correct it as docs/session.md says."
