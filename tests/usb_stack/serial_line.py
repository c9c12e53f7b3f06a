"""A guest's serial port, read line by line and never for longer than allowed."""

from __future__ import annotations

import os
import re
import select
import time
from collections.abc import Iterator
from typing import final

_LONGEST_LINE = 1 << 16


@final
class SerialLine:
    """What comes out of a guest's serial port, until it ends or a deadline passes, which may be moved meanwhile."""

    def __init__(self, descriptor: int, deadline_s: float) -> None:
        self._descriptor = descriptor
        self.deadline_s = deadline_s

    def lines(self) -> Iterator[str]:
        """Line by line."""
        rest = b""
        while select.select([self._descriptor], [], [], max(0.0, self.deadline_s - time.monotonic()))[0]:
            data = os.read(self._descriptor, 1 << 16)
            if not data:
                break
            *whole, rest = (rest + data).split(b"\n")
            yield from (_clean(line) for line in whole)
            rest = rest[-_LONGEST_LINE:]
        if rest:
            yield _clean(rest)


def _clean(line: bytes) -> str:
    return re.sub(r"\x1b(\[[0-9;?=]*[A-Za-z]|c)|[\r\0]", "", line.decode(errors="replace"))
