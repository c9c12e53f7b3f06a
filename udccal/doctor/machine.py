"""The computer under examination; tests replace it by another."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import final

# A value in sysfs fits into one page of memory (Linux, Documentation/filesystems/sysfs.rst).
_LONGEST_VALUE = 4096


def may_open(path: Path) -> bool:
    """Return whether this user may read and write a device; ask the system, so that access lists count."""
    return os.access(path, os.R_OK | os.W_OK)


@final
@dataclass(frozen=True)
class Machine:
    """Where to look.

    Attributes:
        root: root of the file system.
        system: name in ``sys.platform``.
        may_open: returns whether this user may read and write a device.
    """

    root: Path = Path("/")
    system: str = sys.platform
    may_open: Callable[[Path], bool] = may_open

    def value(self, path: Path) -> str | None:
        """Return the printable text of a small file such as those of sysfs; None when it cannot be read."""
        try:
            with path.open("rb") as stream:
                content = stream.read(_LONGEST_VALUE)
        except OSError:
            return None
        text = content.decode("utf-8", "replace").replace("\0", "")
        return "".join(c if c.isprintable() else " " for c in text).strip()
