"""Reads a camera's own description: finds it through its manifest, checks it and unzips it in memory."""

from __future__ import annotations

import codecs
import hashlib
import io
import re
import struct
import zipfile
import zlib
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Protocol, final, runtime_checkable
from xml.parsers import expat

from udccal.cameras.u3v.outline import check_outline, unsound
from udccal.errors import CameraError

# Files of real cameras have 0.1 to 4 MiB unzipped.
_MOST_FILE_BYTES: Final = 8 << 20
_MOST_XML_BYTES: Final = 32 << 20
_MOST_ENTRIES: Final = 32
_WORD_BYTES: Final = 4

# An entry of the manifest table (GenICam GenCP): file version, schema word, address, size, SHA-1, reserved.
_ENTRY: Final = struct.Struct("<IIQQ20s20x")
_DEVICE_XML: Final = 0
_UNCOMPRESSED: Final = 0
_ZIPPED: Final = 1
# The beginning of a file that declares an encoding.
_DECLARATION: Final = re.compile(
    rb"""(<\?xml\s[\x20-\x3d\x3f-\x7e\s]{0,200}?\sencoding\s*=\s*["'])([\w.-]{1,40})(["'])""", re.ASCII
)
_ENCODINGS: Final = MappingProxyType({"iso-8859-1": "iso-8859-1", "latin1": "iso-8859-1", "windows-1252": "cp1252"})
_ZIP_ERRORS: Final = (
    zipfile.BadZipFile,
    zlib.error,
    NotImplementedError,  # a method of compression that Python does not know
    RuntimeError,  # encrypted
    EOFError,
    OSError,
    ValueError,
    struct.error,
    KeyError,
    IndexError,
    OverflowError,
)


@runtime_checkable
class Memory(Protocol):
    """A device's memory."""

    def read(self, address: int, length: int) -> bytes:
        """Read ``length`` bytes from an address."""
        ...


@final
@dataclass(frozen=True)
class ManifestEntry:
    """One file in a device's memory.

    Attributes:
        version: major, minor, subminor.
        sha1: SHA-1 of the stored file; None when the device does not give it.
    """

    version: tuple[int, int, int]
    file_type: int
    file_format: int
    address: int
    size: int
    sha1: bytes | None


def read_description(memory: Memory, manifest_address: int) -> str:
    """Return the newest description of a device, as checked XML.

    Raises:
        CameraProtocolError: when there is none, or it is damaged, too long, or does not match its SHA-1.
        CameraTimeout, CameraLost, CameraError: as for ``ControlChannel.read``.
    """
    entries = [e for e in _read_manifest(memory, manifest_address) if e.file_type == _DEVICE_XML]
    if not entries:
        raise unsound("a manifest that names a description", "none in it")
    entry = max(entries, key=lambda e: e.version)
    if not 0 < entry.size <= _MOST_FILE_BYTES:
        raise unsound(f"a description of up to {_MOST_FILE_BYTES} bytes", f"{entry.size}")
    stored = _read_file(memory, entry.address, entry.size)
    if entry.sha1 is not None and hashlib.sha1(stored, usedforsecurity=False).digest() != entry.sha1:
        raise unsound("a description with the SHA-1 of the manifest", "another")
    return checked_xml(unpacked(stored, entry.file_format))


def _read_file(memory: Memory, address: int, size: int) -> bytes:
    """Read a file of any size; its last bytes as a whole word where the device reads nothing else."""
    rest = size % _WORD_BYTES
    stored = memory.read(address, size - rest)
    if not rest:
        return stored
    end = address + size - rest
    try:
        return stored + memory.read(end, rest)
    except CameraError:
        return stored + memory.read(end, _WORD_BYTES)[:rest]


def _read_manifest(memory: Memory, address: int) -> tuple[ManifestEntry, ...]:
    count = struct.unpack("<Q", memory.read(address, 8))[0]
    if count > _MOST_ENTRIES:
        raise unsound(f"a manifest of up to {_MOST_ENTRIES} entries", f"{count}")
    return tuple(parse_entry(memory.read(address + 8 + i * _ENTRY.size, _ENTRY.size)) for i in range(count))


def parse_entry(data: bytes) -> ManifestEntry:
    """Return the manifest entry in its 64 bytes.

    Raises:
        CameraProtocolError: when there are fewer or more.
    """
    if len(data) != _ENTRY.size:
        raise unsound(f"a manifest entry of {_ENTRY.size} bytes", f"{len(data)}")
    version, schema, address, size, sha1 = _ENTRY.unpack(data)
    return ManifestEntry(
        version=(version >> 24, version >> 16 & 0xFF, version & 0xFFFF),
        file_type=schema & 0x7,
        file_format=schema >> 10 & 0x3F,
        address=address,
        size=size,
        sha1=sha1 if any(sha1) else None,
    )


def unpacked(stored: bytes, file_format: int) -> bytes:
    """Return the XML in a file: the file itself, or the only XML in a zip.

    Raises:
        CameraProtocolError: when the zip is damaged, has no XML, or is longer than any description.
    """
    if file_format == _UNCOMPRESSED:
        return stored
    if file_format != _ZIPPED:
        raise unsound("a description that is plain or zipped", f"format {file_format}")
    try:
        with zipfile.ZipFile(io.BytesIO(stored)) as archive:
            names = [m for m in archive.infolist() if m.filename.lower().endswith(".xml")]
            if not names:
                raise unsound("a zip with an XML file", f"{len(archive.infolist())} other files")
            with archive.open(names[0]) as member:
                # Read no further than allowed, whatever size the zip claims.
                xml = member.read(_MOST_XML_BYTES + 1)
    except _ZIP_ERRORS as error:
        raise unsound("a readable zip", f"{type(error).__name__}: {str(error)[:80]}") from error
    if len(xml) > _MOST_XML_BYTES:
        raise unsound(f"a description of up to {_MOST_XML_BYTES} bytes", "a longer one")
    return xml


def checked_xml(raw: bytes) -> str:
    """Return well-formed XML whose outline is safe for GenApi; it declares UTF-8, or no encoding.

    Raises:
        CameraProtocolError: otherwise.
    """
    try:
        # Some devices pad their file with zeros.
        text = _text(raw.rstrip(b"\0"))
        # GenApi gets exactly the text that is checked here.
        check_outline(text)
    except UnicodeDecodeError as error:
        raise unsound(f"a description in {error.encoding.upper()}", "bytes that are not") from error
    except expat.ExpatError as error:
        raise unsound("well-formed XML", f"{expat.ErrorString(error.code)} in line {error.lineno}") from error
    return text


def _text(raw: bytes) -> str:
    """Decode text from the encoding that it declares, one of a few; else from UTF-8, as after UTF-8's mark."""
    unmarked = raw.removeprefix(codecs.BOM_UTF8)
    declared = _DECLARATION.match(unmarked)
    if declared is None:
        return unmarked.decode("utf-8")
    head, name, tail = (part.decode("ascii") for part in declared.groups())
    encoding = _ENCODINGS.get(name.lower(), "utf-8") if len(unmarked) == len(raw) else "utf-8"
    return f"{head}utf-8{tail}{unmarked[declared.end() :].decode(encoding)}"
