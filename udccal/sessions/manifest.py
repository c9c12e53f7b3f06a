"""Reading and writing ``session.json``: strictly checked, of bounded size, and written atomically."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

from pydantic import ValidationError

from udccal.errors import SessionError
from udccal.io.atomic import write_atomically
from udccal.io.links import is_plain_file
from udccal.sessions.schema import Manifest

MANIFEST_NAME = "session.json"
PREVIOUS_NAME = "session.previous.json"
DAMAGED_NAME = "session.damaged.json"
FORMAT = "udccal-session"
VERSION = 1
_MAX_BYTES = 64 * 1024 * 1024
_BLANK = b"0" * 64  # placeholder for the manifest's own checksum while that is computed
_SEAL = re.compile(rb'"manifest_sha256":\s*"([0-9a-f]{64})"')


class NewerManifestError(SessionError):
    """A whole manifest of a later version of udccal, which this version cannot read."""


def read_manifest(folder: Path, name: str = MANIFEST_NAME) -> Manifest:
    """Read and check the manifest of a session.

    Args:
        folder: the session's folder.
        name: the file's name in it.

    Raises:
        SessionError: when it is missing, too large, not JSON, of a newer version, changed after it was written, or
            does not follow docs/session.md.
    """
    file, content = folder / name, _content(folder, name)
    _check_seal(file, content)
    _check_version(file, content)
    try:
        return Manifest.model_validate_json(content, strict=True)
    except ValidationError as error:
        raise SessionError(_sentence(file, error)) from error


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Replace the manifest atomically: a reader sees the old one or the new one, never a part of either."""
    blank = manifest.model_copy(update={"manifest_sha256": _BLANK.decode()})
    content = blank.model_dump_json(indent=1).encode() + b"\n"
    seal = hashlib.sha256(content).hexdigest().encode()
    write_atomically(folder / MANIFEST_NAME, content.replace(_BLANK, seal, 1))


def keep_previous(folder: Path) -> None:
    """Copy the present manifest, so that damage to the next one costs one step only."""
    write_atomically(folder / PREVIOUS_NAME, _content(folder, MANIFEST_NAME))


def _content(folder: Path, name: str) -> bytes:
    file = folder / name
    if not is_plain_file(folder, file):
        found = "a link" if file.is_symlink() else "none"
        raise SessionError(
            f"Expected a session with a {name} at {folder}, found {found}. Check the path, or capture one."
        )
    size = file.stat().st_size
    if size > _MAX_BYTES:
        raise SessionError(f"Expected {file} to hold at most {_MAX_BYTES} bytes, found {size}. It is not a manifest.")
    return file.read_bytes()


def _check_seal(file: Path, content: bytes) -> None:
    """Compare a manifest with its own checksum, if it has one; other programs may write none."""
    seal = _SEAL.search(content)
    if seal is None:
        return
    start, end = seal.span(1)
    if hashlib.sha256(content[:start] + _BLANK + content[end:]).hexdigest() != seal[1].decode():
        raise SessionError(
            f"Expected {file} to match its own checksum, found that it was changed or damaged. Capture again, which "
            "continues from the copy kept before the last step. If you edited the file, remove the entry "
            "'manifest_sha256'."
        )


def _check_version(file: Path, content: bytes) -> None:
    """Refuse other formats and newer versions before strict validation, which would only name an unknown entry."""
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise SessionError(f"Expected {file} to be JSON, found: {error}. Restore it from a copy.") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise SessionError(f"Expected {file} to have the format '{FORMAT}', found another. Check the path.")
    version = found.get("version")
    if isinstance(version, int) and version > VERSION:
        raise NewerManifestError(
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
        return f"Expected in {where} of {file} {first['ctx']['error']}, found otherwise. Correct it."
    found = repr(first["input"])
    shown = found if len(found) <= 60 else found[:57] + "..."
    return f"Expected a valid '{where}' in {file} ({first['msg']}), found {shown}. Correct it as docs/session.md says."
