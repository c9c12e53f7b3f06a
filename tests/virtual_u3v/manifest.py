"""The manifest table (GenCP 1.x §5.2) and the GenICam file it points to, sound or spoilt as ordered."""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
from dataclasses import dataclass

from tests.virtual_u3v import registers as at
from tests.virtual_u3v.description import XML_NAME, description_of, zipped
from tests.virtual_u3v.faults import DescriptionFault
from tests.virtual_u3v.model import CameraModel

_ZIPPED = 1 << 10
_SCHEMA_1_1 = 1 << 24 | 1 << 16
_BOMB_BLOCK, _BOMB_BLOCKS = 1 << 20, 128


@dataclass(frozen=True)
class Manifest:
    """What stands in the camera's memory: the table and the file."""

    table: bytes
    file: bytes


def manifest_of(model: CameraModel, fault: DescriptionFault) -> Manifest:
    """The manifest of one entry and its file."""
    file = _file(model, fault)
    size = 1 << 40 if fault is DescriptionFault.HUGE_SIZE else len(file)
    entries = {DescriptionFault.NO_ENTRIES: 0, DescriptionFault.ENDLESS_MANIFEST: 1 << 63}.get(fault, 1)
    digest = hashlib.sha1(b"another" if fault is DescriptionFault.WRONG_SHA1 else file).digest()
    kind = _SCHEMA_1_1 | (0 if fault is DescriptionFault.UNCOMPRESSED else _ZIPPED)
    version = struct.pack("<HBB", 0, 0, 1)  # sub-minor, minor, major of the file
    entry = version + struct.pack("<IQQ", kind, at.DESCRIPTION, size) + digest + bytes(20)
    return Manifest(struct.pack("<Q", entries) + entry, file)


def _file(model: CameraModel, fault: DescriptionFault) -> bytes:
    match fault:
        case DescriptionFault.MALFORMED_XML:
            return zipped("<RegisterDescription><Category Name=")
        case DescriptionFault.ZIP_BOMB:
            return _bomb()
        case DescriptionFault.UNCOMPRESSED:
            return description_of(model).encode()
        case DescriptionFault.DAMAGED_ZIP:
            whole = bytearray(zipped(description_of(model)))
            for place in range(len(whole) // 3, len(whole) // 3 + 64):
                whole[place] ^= 0xFF
            return bytes(whole)
        case _:
            return zipped(description_of(model))


def _bomb() -> bytes:
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open(XML_NAME, "w") as member,
    ):
        for _ in range(_BOMB_BLOCKS):
            member.write(b" " * _BOMB_BLOCK)
    return buffer.getvalue()
