from __future__ import annotations

import hashlib
import io
import struct
import zipfile
from collections.abc import Callable

import pytest

from udccal.cameras.u3v.description import checked_xml, parse_entry, read_description, unpacked
from udccal.errors import CameraError, CameraProtocolError

SENTENCE = r"Expected .* found .*\. \w+"
XML = '<?xml version="1.0"?><RegisterDescription><Category Name="Root"/></RegisterDescription>'


class Memory:
    """Bytes at one address, which counts what is read."""

    def __init__(self, base: int, content: bytes) -> None:
        self.base, self.content, self.bytes_read = base, content, 0

    def read(self, address: int, length: int) -> bytes:
        self.bytes_read += length
        start = address - self.base
        if start < 0 or start + length > len(self.content):
            raise CameraProtocolError("Expected an address, found none. Stop.")
        return self.content[start : start + length]


def zipped(content: bytes, name: str = "camera.xml") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return buffer.getvalue()


def entry(address: int, size: int, schema: int = 0x01010000, version: int = 0x01000000, sha1: bytes = b"") -> bytes:
    return struct.pack("<IIQQ", version, schema, address, size) + sha1.ljust(20, b"\0") + bytes(20)


def manifest(*files: tuple[bytes, int, int], sha1: Callable[[bytes], bytes] = lambda data: b"") -> Memory:
    """Files, each with schema and version, behind their entries."""
    table, stored, base = struct.pack("<Q", len(files)), b"", 0x1000
    start = base + 8 + 64 * len(files)
    for data, schema, version in files:
        table += entry(start + len(stored), len(data), schema, version, sha1(data))
        stored += data
    return Memory(base, table + stored)


def test_entry_byte_by_byte() -> None:
    data = bytes.fromhex(
        "0300"
        "02"
        "01"  # version 1.2.3
        "00040101"  # device XML, zipped, schema 1.1
        "0000010000000000"
        "1027000000000000" + "ab" * 20 + "00" * 20
    )
    parsed = parse_entry(data)
    assert (parsed.version, parsed.file_type, parsed.file_format) == ((1, 2, 3), 0, 1)
    assert (parsed.address, parsed.size, parsed.sha1) == (0x10000, 10000, b"\xab" * 20)
    assert parse_entry(data[:24] + bytes(40)).sha1 is None


@pytest.mark.parametrize("length", [0, 63, 65])
def test_refuses_entries_of_another_length(length: int) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        parse_entry(bytes(length))


@pytest.mark.parametrize(("stored", "schema"), [(XML.encode(), 0x01010000), (zipped(XML.encode()), 0x01010400)])
def test_reads_plain_and_zipped(stored: bytes, schema: int) -> None:
    memory = manifest((stored, schema, 0), sha1=lambda data: hashlib.sha1(data).digest())
    assert read_description(memory, memory.base) == XML


@pytest.mark.parametrize("rest", range(4))
def test_reads_files_of_any_length_from_devices_that_read_whole_words_alone(rest: int) -> None:
    stored = XML.encode()
    stored += b" " * ((rest - len(stored)) % 4)
    memory = manifest((stored, 0x01010000, 0))
    memory.content += bytes(4)

    class Words:
        def read(self, address: int, length: int) -> bytes:
            if address % 4 or length % 4:
                raise CameraError("Expected whole words, found others. Ask for those.")
            return memory.read(address, length)

    assert read_description(Words(), memory.base) == stored.decode()


def test_takes_the_newest_device_description() -> None:
    new = XML.replace("Root", "New")
    memory = manifest(
        (XML.encode(), 0x01010000, 0x01020009),
        (new.encode(), 0x01010000, 0x02000000),
        (b"chunks only", 0x01010001, 0x03000000),  # a description of buffers
    )
    assert read_description(memory, memory.base) == new


def test_refuses_another_sha1() -> None:
    memory = manifest((XML.encode(), 0, 0), sha1=lambda data: hashlib.sha1(data + b"!").digest())
    with pytest.raises(CameraProtocolError, match="SHA-1"):
        read_description(memory, memory.base)


@pytest.mark.parametrize("count", [0, 33, 1 << 63])
def test_refuses_manifests_of_no_or_endless_entries(count: int) -> None:
    memory = Memory(0, struct.pack("<Q", count) + bytes(64 * 40))
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        read_description(memory, 0)
    assert memory.bytes_read == 8


def test_refuses_manifests_without_a_device_description() -> None:
    memory = manifest((XML.encode(), 0x01010001, 0))
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        read_description(memory, memory.base)


@pytest.mark.parametrize("size", [0, (8 << 20) + 1, 1 << 40, (1 << 64) - 1])
def test_refuses_sizes_before_reading(size: int) -> None:
    memory = Memory(0, struct.pack("<Q", 1) + entry(0x48, size) + bytes(64))
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        read_description(memory, 0)
    assert memory.bytes_read == 72


def test_refuses_damaged_zips() -> None:
    sound = zipped(XML.encode() * 10)
    assert unpacked(sound, 1) == XML.encode() * 10
    refused = 0
    for position in range(len(sound)):
        damaged = bytearray(sound)
        damaged[position] ^= 0xFF
        try:
            unpacked(bytes(damaged), 1)
        except CameraProtocolError:
            refused += 1
    # Dates, attributes and such may be anything.
    assert refused > len(sound) // 2
    for length in range(len(sound) - 1):
        with pytest.raises(CameraProtocolError, match=SENTENCE):
            unpacked(sound[:length], 1)


def test_refuses_zip_bombs_without_unpacking_them() -> None:
    bomb = zipped(bytes(64 << 20))
    assert len(bomb) < 1 << 20
    with pytest.raises(CameraProtocolError, match="longer"):
        unpacked(bomb, 1)


def test_refuses_zips_without_xml_and_unknown_formats() -> None:
    with pytest.raises(CameraProtocolError, match="XML"):
        unpacked(zipped(b"hello", "readme.txt"), 1)
    with pytest.raises(CameraProtocolError, match="format 2"):
        unpacked(XML.encode(), 2)


@pytest.mark.parametrize("raw", [XML.encode(), b"\xef\xbb\xbf" + XML.encode(), XML.encode() + bytes(5)])
def test_accepts_sound_xml(raw: bytes) -> None:
    assert checked_xml(raw) == XML


@pytest.mark.parametrize(
    "text",
    [
        "",
        "hello",
        XML[:-5],
        XML.replace("RegisterDescription", "html"),
        '<!DOCTYPE RegisterDescription [<!ENTITY a "aaaa">]><RegisterDescription>&a;</RegisterDescription>',
        '<!DOCTYPE x SYSTEM "file:///etc/passwd"><RegisterDescription/>',
        "<RegisterDescription>&undefined;</RegisterDescription>",
        "<RegisterDescription>" + "<a>" * 40 + "</a>" * 40 + "</RegisterDescription>",
        XML.replace("Root", "\x00"),
    ],
    ids=range(9),
)
def test_refuses_unsound_xml(text: str) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE) as caught:
        checked_xml(text.encode())
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "nodes",
    [
        '<IntReg Name="R"><pPort>Device</pPort></IntReg><Integer Name="Device"/>',
        '<IntReg Name="R"><pPort>Nowhere</pPort></IntReg>',
        '<IntReg Name="R"><pPort>R</pPort></IntReg>',
        '<Category Name="Root"><pFeature>Device</pFeature></Category><Port Name="Device"/>',
        '<Integer Name="I"><pValue> Device\n</pValue></Integer><Port Name="Device"/>',
        '<Group><Integer Name="I"><pMin>Device</pMin></Integer></Group><g:Port Name="Device"/>',
    ],
)
def test_refuses_references_that_genapi_would_follow_into_the_void(nodes: str) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        checked_xml(f"<RegisterDescription>{nodes}</RegisterDescription>".encode())


def test_accepts_references_of_the_right_kind() -> None:
    nodes = '<IntReg Name="R"><pPort>\n Device</pPort><pMin>R</pMin></IntReg><Group><Port Name="Device"/></Group>'
    text = f"<RegisterDescription>{nodes}</RegisterDescription>"
    assert checked_xml(text.encode()) == text


def test_refuses_more_elements_than_any_camera_has(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("udccal.cameras.u3v.outline._MOST_ELEMENTS", 1000)
    checked_xml(b"<RegisterDescription>" + b"<a/>" * 999 + b"</RegisterDescription>")
    with pytest.raises(CameraProtocolError, match="1000 elements"):
        checked_xml(b"<RegisterDescription>" + b"<a/>" * 1000 + b"</RegisterDescription>")


def test_refuses_other_encodings() -> None:
    with pytest.raises(CameraProtocolError, match="UTF-8"):
        checked_xml(XML.replace("Root", "Ä").encode("latin-1"))
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        checked_xml(XML.encode("utf-16"))


@pytest.mark.parametrize("declared", ["ISO-8859-1", "iso-8859-1", "windows-1252"])
def test_accepts_the_encoding_that_a_description_declares(declared: str) -> None:
    text = f'<?xml version="1.0" encoding="{declared}"?><RegisterDescription ToolTip="°C µs"/>'
    # What is handed on declares what it then is.
    assert checked_xml(text.encode("latin-1")) == text.replace(declared, "utf-8")


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("declared", ["UTF-8", "utf-16", "zip", "rot13", "no-such-thing"])
def test_everything_else_is_utf_8_whatever_it_declares(mark: bytes, declared: str) -> None:
    text = f'<?xml version="1.0" encoding="{declared}"?><RegisterDescription ToolTip="°C µs"/>'
    assert checked_xml(mark + text.encode()) == text.replace(declared, "utf-8")
    with pytest.raises(CameraProtocolError, match="UTF-8"):
        checked_xml(mark + text.encode("latin-1"))


def test_a_byte_order_mark_counts_more_than_the_declaration() -> None:
    text = '<?xml version="1.0" encoding="ISO-8859-1"?><RegisterDescription ToolTip="°C"/>'
    assert checked_xml(b"\xef\xbb\xbf" + text.encode()) == text.replace("ISO-8859-1", "utf-8")


def test_names_within_a_node_are_no_names_of_nodes() -> None:
    nodes = (
        '<Port Name="Device"/><IntReg Name="R"><pPort>Device</pPort></IntReg>'
        '<Enumeration Name="E"><EnumEntry Name="Device"><Value>0</Value></EnumEntry></Enumeration>'
        '<IntSwissKnife Name="K"><pVariable Name="Device">R</pVariable><Formula>Device</Formula></IntSwissKnife>'
    )
    text = f"<RegisterDescription>{nodes}</RegisterDescription>"
    assert checked_xml(text.encode()) == text


@pytest.mark.parametrize(
    "nodes",
    [
        '<Integer Name="I"><Port Name="P"/></Integer>',
        '<Integer Name="Device"/><Integer Name="I"><Port Name="Device"/></Integer><A><pPort>Device</pPort></A>',
        '<StructReg><pPort>S</pPort><StructEntry Name="S"/></StructReg><Port Name="Device"/>',
    ],
)
def test_nothing_within_a_node_passes_for_a_port(nodes: str) -> None:
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        checked_xml(f"<RegisterDescription>{nodes}</RegisterDescription>".encode())
