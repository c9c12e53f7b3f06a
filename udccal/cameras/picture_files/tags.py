"""Reads fields of TIFF directories, the base of DNG and most camera raw files (TIFF 6.0, section 2).

The size and place of each field are checked against the file before it is read; fields not needed are not read.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final, final

from udccal.errors import FileFormatError

_MAX_FIELD_BYTES: Final = 1 << 20
_INLINE_BYTES: Final = 4
_FIELD_BYTES: Final = 12
# Bytes and letter (of the module ``struct``) per value of the field types 1 to 13; rationals are pairs.
_TYPES: Final = ("", "B", "s", "H", "I", "II", "b", "B", "h", "i", "ii", "f", "d", "I")
_TEXT: Final = 2
_LITTLE, _BIG = b"II*\0", b"MM\0*"


@final
@dataclass(frozen=True)
class Field:
    """One field of a directory, not read yet: ``kind`` is TIFF's field type, ``where`` the content's offset."""

    tag: int
    kind: int
    count: int
    where: int


def is_tiff(start: bytes) -> bool:
    """Return whether a file that begins this way consists of TIFF directories with 32-bit offsets."""
    return start[:4] in (_LITTLE, _BIG)


@final
class Directory:
    """One directory of an open file.

    Attributes:
        fields: fields in the order of the file.
        following: offset of the next directory, 0 for none.
    """

    def __init__(self, stream: BinaryIO, path: Path, order: str, offset: int) -> None:
        """Read the list of fields at ``offset``; ``order`` is ``<`` or ``>``.

        Raises:
            FileFormatError: when it does not lie in the file.
        """
        self._stream, self._path, self._order = stream, path, order
        self._size = os.fstat(stream.fileno()).st_size
        (length,) = struct.unpack(f"{order}H", self._bytes(offset, 2))
        content = self._bytes(offset + 2, length * _FIELD_BYTES + 4)
        places = range(0, length * _FIELD_BYTES, _FIELD_BYTES)
        self.fields = tuple(self._field(content[at : at + _FIELD_BYTES], offset + 2 + at) for at in places)
        (self.following,) = struct.unpack(f"{order}I", content[-4:])

    @staticmethod
    def first(stream: BinaryIO, path: Path) -> Directory:
        """Return the directory that the header points to.

        Raises:
            FileFormatError: when the file is not TIFF with 32-bit offsets, or damaged.
        """
        stream.seek(0)
        header = stream.read(8)
        if len(header) < 8 or not is_tiff(header):
            raise FileFormatError(f"Expected {path} to be a TIFF file, found other content. Check the file.")
        order = "<" if header.startswith(_LITTLE) else ">"
        return Directory(stream, path, order, struct.unpack(f"{order}I", header[4:])[0])

    def under(self, tag: int) -> Directory | None:
        """Return the directory that a field points to, if there is one."""
        offsets = self.integers(tag)
        return Directory(self._stream, self._path, self._order, offsets[0]) if offsets else None

    def integers(self, tag: int) -> tuple[int, ...]:
        """Return the whole numbers of a field; empty when it is absent."""
        return tuple(value for value in self._values(tag) if isinstance(value, int))

    def number(self, tag: int) -> float | None:
        """Return the first number of a field, rationals as quotients; None when absent or divided by 0."""
        field = self._find(tag)
        values = [value for value in self._values(tag) if isinstance(value, int | float)]
        if field is None or not values:
            return None
        if len(_TYPES[field.kind]) == 1:
            return float(values[0])
        return values[0] / values[1] if values[1] else None

    def text(self, tag: int) -> str:
        """Return a text up to its first zero byte, printable ASCII only; empty when absent."""
        field = self._find(tag)
        if field is None or field.kind != _TEXT:
            return ""
        shown = self._content(field).split(b"\0")[0].decode("ascii", "replace")
        return "".join(letter if letter.isprintable() else "?" for letter in shown).strip()

    def _field(self, record: bytes, at: int) -> Field:
        tag, kind, count = struct.unpack(f"{self._order}HHI", record[:8])
        inline = not 1 <= kind < len(_TYPES) or _bytes_of(kind) * count <= _INLINE_BYTES
        where = at + 8 if inline else struct.unpack(f"{self._order}I", record[8:])[0]
        return Field(tag, kind, count, where)

    def _find(self, tag: int) -> Field | None:
        return next((field for field in self.fields if field.tag == tag and 1 <= field.kind < len(_TYPES)), None)

    def _values(self, tag: int) -> tuple[int | float | bytes, ...]:
        field = self._find(tag)
        if field is None or field.count == 0:
            return ()
        letters = _TYPES[field.kind]
        return struct.unpack(f"{self._order}{field.count * len(letters)}{letters[0]}", self._content(field))

    def _content(self, field: Field) -> bytes:
        return self._bytes(field.where, _bytes_of(field.kind) * field.count)

    def _bytes(self, offset: int, length: int) -> bytes:
        if length > _MAX_FIELD_BYTES or offset + length > self._size:
            raise self._damaged(f"{length} bytes at {offset} of {self._size}")
        self._stream.seek(offset)
        content = self._stream.read(length)
        if len(content) != length:
            raise self._damaged(f"{len(content)} of {length} bytes at {offset}")
        return content

    def _damaged(self, found: str) -> FileFormatError:
        return FileFormatError(f"Expected the fields of {self._path} to lie in it, found {found}. Copy it again.")


def _bytes_of(kind: int) -> int:
    return struct.calcsize(f"={_TYPES[kind]}")
