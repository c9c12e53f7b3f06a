"""Writes TIFF and DNG files field by field, right ones and wrong ones."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt16

_SHORT, _LONG, _RATIONAL, _ASCII, _BYTE = 3, 4, 5, 2, 1
_LETTERS = {_SHORT: "H", _LONG: "I", _BYTE: "B"}
_CFA_BYTES = {"R": 0, "G": 1, "B": 2}
EXIF = 34665


@dataclass(frozen=True)
class Entry:
    """A field of a directory: its type's number, how many values, and their bytes."""

    tag: int
    kind: int
    count: int
    content: bytes


def whole(tag: int, *values: int, kind: int = _LONG) -> Entry:
    return Entry(tag, kind, len(values), struct.pack(f"<{len(values)}{_LETTERS[kind]}", *values))


def shorts(tag: int, *values: int) -> Entry:
    return whole(tag, *values, kind=_SHORT)


def rational(tag: int, *values: Fraction | tuple[int, int]) -> Entry:
    pairs = [v if isinstance(v, tuple) else (v.numerator, v.denominator) for v in values]
    return Entry(tag, _RATIONAL, len(pairs), b"".join(struct.pack("<2I", *pair) for pair in pairs))


def text(tag: int, value: str) -> Entry:
    content = value.encode() + b"\0"
    return Entry(tag, _ASCII, len(content), content)


def directory(entries: Sequence[Entry], at: int, following: int = 0) -> bytes:
    """A directory and the contents of its fields, to stand at that offset."""
    ordered = sorted(entries, key=lambda entry: entry.tag)
    records, contents = b"", b""
    beyond = at + 2 + 12 * len(ordered) + 4
    for entry in ordered:
        inline = len(entry.content) <= 4
        value = entry.content.ljust(4, b"\0") if inline else struct.pack("<I", beyond + len(contents))
        records += struct.pack("<HHI", entry.tag, entry.kind, entry.count) + value
        contents += b"" if inline else entry.content + b"\0" * (len(entry.content) % 2)
    return struct.pack("<H", len(ordered)) + records + struct.pack("<I", following) + contents


def write_tiff(path: Path, entries: Sequence[Entry], samples: bytes, exif: Sequence[Entry] = ()) -> None:
    """Header, samples (at offset 8), Exif, then the main directory."""
    at = 8 + len(samples)
    inner = directory(exif, at) if exif else b""
    main = [*entries, whole(EXIF, at)] if exif else list(entries)
    first = at + len(inner)
    path.write_bytes(struct.pack("<2sHI", b"II", 42, first) + samples + inner + directory(main, first))


def grey_entries(mosaic: UInt16[np.ndarray, "rows columns"]) -> list[Entry]:
    """Fields of an uncompressed 16-bit picture of one channel whose samples stand at offset 8."""
    rows, columns = mosaic.shape
    return [
        whole(256, columns),
        whole(257, rows),
        shorts(258, 16),
        shorts(259, 1),
        shorts(262, 1),
        whole(273, 8),
        shorts(277, 1),
        whole(278, rows),
        whole(279, mosaic.nbytes),
    ]


@dataclass(frozen=True)
class Shot:
    """What a camera writes into a raw file; None leaves a field out, and 0 is written as it is."""

    exposure: tuple[int, int] | None = (1, 125)
    iso: int | None = 100
    taken: str | None = "2024:05:01 12:00:00"
    subseconds: str | None = None
    make: str = "Maker"
    model: str = "M1"
    serial: str = "0042"
    cfa: str = "RGGB"
    black: int = 64
    white: int = 4095


def write_dng(path: Path, mosaic: UInt16[np.ndarray, "rows columns"], shot: Shot | None = None) -> None:
    """A DNG of one picture."""
    shot = shot or Shot()
    pattern = [_CFA_BYTES[letter] for letter in shot.cfa]
    replaced = [whole(254, 0), shorts(262, 32803), text(271, shot.make), text(272, shot.model)]
    identity = Fraction(1)
    dng = [
        shorts(33421, 2, 2),
        whole(33422, *pattern, kind=_BYTE),
        whole(50706, 1, 4, 0, 0, kind=_BYTE),
        text(50708, f"{shot.make} {shot.model}"),
        whole(50714, shot.black),
        whole(50717, shot.white),
        Entry(50721, 10, 9, struct.pack("<18i", *(v for i in range(9) for v in (int(i % 4 == 0), 1)))),
        rational(50728, identity, identity, identity),
        text(50735, shot.serial),
        shorts(50778, 21),
    ]
    kept = [entry for entry in grey_entries(mosaic) if entry.tag != 262]
    exif = [
        *([rational(33434, shot.exposure)] if shot.exposure is not None else []),
        *([shorts(34855, shot.iso)] if shot.iso is not None else []),
        *([text(36867, shot.taken)] if shot.taken is not None else []),
        *([text(37521, shot.subseconds)] if shot.subseconds is not None else []),
        shorts(41989, 0),
    ]
    write_tiff(path, [*kept, *replaced, *dng], mosaic.astype("<u2").tobytes(), exif)
