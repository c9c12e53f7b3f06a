"""What a target of the fuzzer is."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from udccal.errors import UdccalError


@dataclass(frozen=True)
class Target:
    """A reader of bytes from outside.

    Attributes:
        read: takes any bytes; may raise an ``UdccalError``, and nothing else.
        seeds: whole examples, from which broken ones are made.
        max_bytes: longest input to try.
        one_in: how many inputs of others there are for each of this target; above 1 where one takes long.
        longest_s: seconds of the processor that an input may take; an input that takes five times as long hangs.
    """

    name: str
    read: Callable[[bytes], object]
    seeds: Callable[[], tuple[bytes, ...]]
    max_bytes: int = 4096
    one_in: int = 1
    longest_s: float = 2.0

    def try_out(self, data: bytes) -> bool:
        """Whether the reader took the bytes; a refusal in words is as good."""
        try:
            self.read(data)
        except UdccalError as error:
            sentence = str(error)
            if not sentence.startswith("Expected ") or "found" not in sentence:
                raise AssertionError(
                    f"expected a sentence of what was expected and found, found: {sentence}"
                ) from error
            return False
        return True


def of_file(name: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    """A reader of bytes out of a reader of files; the file has the name given, since some readers look at it."""
    folder = tempfile.TemporaryDirectory(prefix="udccal-fuzz-")

    def read_bytes(data: bytes) -> object:
        path = Path(folder.name) / name
        path.write_bytes(data)
        return read(path)

    return read_bytes


def written(name: str, write: Callable[[Path], object]) -> bytes:
    """The bytes that a writer of files writes."""
    with tempfile.TemporaryDirectory(prefix="udccal-fuzz-") as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()
