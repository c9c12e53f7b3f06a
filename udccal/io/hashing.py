"""Checksums of files."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from udccal.errors import FileFormatError
from udccal.io.limits import MAX_PICTURE_BYTES


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of the file at ``path`` as 64 lower-case hexadecimal digits, in constant memory.

    Raises:
        FileFormatError: when it is larger than any file of a session or profile; it is not read then.
        OSError: when it cannot be read.
    """
    with path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > MAX_PICTURE_BYTES:
            raise FileFormatError(
                f"Expected {path} to hold at most {MAX_PICTURE_BYTES} bytes, found {size}. Check that it is the right "
                "file."
            )
        return hashlib.file_digest(stream, "sha256").hexdigest()
