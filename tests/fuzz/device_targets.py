"""What a USB3 Vision device sends: acknowledges, leaders, trailers, chunks, and the description of its features."""

from __future__ import annotations

import copy
import hashlib
import struct
from xml.etree import ElementTree

from tests.fuzz.target import Target
from tests.virtual_u3v.description import description_of, zipped
from tests.virtual_u3v.model import CameraModel
from udccal.cameras.u3v.chunks import behind_picture, parse_chunks
from udccal.cameras.u3v.description import checked_xml, parse_entry, unpacked
from udccal.cameras.u3v.gencp import decode_acknowledge, pending_s, written_bytes
from udccal.cameras.u3v.nodes import NodeMap
from udccal.cameras.u3v.stream import parse_leader, parse_trailer
from udccal.errors import UdccalError

_LEADER = struct.pack("<4sHHQHHQIIIIIHH", b"U3VL", 0, 52, 7, 0, 0x0001, 10**9, 0x01100011, 64, 48, 0, 0, 0, 0)
_TRAILER = struct.pack("<4sHHQHHQI", b"U3VT", 0, 32, 7, 0, 0, 6144, 48)
_CHUNKS = bytes(24) + struct.pack("<II", 0x101, 24) + struct.pack("<dII", 4e3, 0x102, 8)
_FEATURES = ("Width", "Height", "ExposureTime", "Gain", "PixelFormat", "PayloadSize", "TriggerMode", "AcquisitionStart")


def _acknowledge(command: int, data: bytes, status: int = 0) -> bytes:
    return struct.pack("<IHHHH", 0x43563355, status, command, len(data), 3) + data


def _decode(data: bytes) -> None:
    acknowledge = decode_acknowledge(data)
    for look in (pending_s, written_bytes):
        try:
            look(acknowledge)
        except UdccalError:
            continue


def _chunks(data: bytes) -> None:
    view = memoryview(data)
    parse_chunks(view)
    behind_picture(view, 24)


class _Noise:
    """A memory that answers every read, differently at each address."""

    def read(self, address: int, length: int) -> bytes:
        """Any bytes, the same each time."""
        return hashlib.shake_128(address.to_bytes(8, "little", signed=False)).digest(min(length, 4096))

    def write(self, address: int, data: bytes) -> None:
        """Taken and forgotten."""


def _describe(data: bytes) -> None:
    """Everything a driver asks of a description when it opens a camera."""
    nodes = NodeMap(checked_xml(data), _Noise())
    try:
        for name in _FEATURES:
            _ask(nodes, name)
    finally:
        nodes.close()


def _change_and_describe(data: bytes) -> None:
    """The description with as many of its elements changed as the bytes say, four for each: what, where, how."""
    root = ElementTree.fromstring(_description())
    elements = list(root.iter())
    for what, where, how in struct.iter_unpack("<BHB", data[: len(data) // 4 * 4]):
        _change(elements[where % len(elements)], elements[how % len(elements)], what)
    _describe(ElementTree.tostring(root))


def _change(element: ElementTree.Element, other: ElementTree.Element, what: int) -> None:
    """Spoil one element with what another one holds, with a bad number, or by taking its place."""
    bad = ("", "0", "-1", "1e309", "nan", "0xFFFFFFFFFFFFFFFF", "9" * 400, "%", "(" * 60, "1/0", "WIDTH+", "\u0394")
    match what % 6:
        case 0:
            element.text = other.text
        case 1:
            element.text = bad[what // 6 % len(bad)]
        case 2:
            element.tag = other.tag
        case 3:
            element.attrib = dict(other.attrib)
        case 4 if len(element):
            element.remove(element[what // 6 % len(element)])
        case _:
            element.extend(copy.deepcopy(list(other)[:4]))


def _ask(nodes: NodeMap, name: str) -> None:
    for question in (nodes.has, nodes.writable, nodes.number, nodes.bounds, nodes.step, nodes.choice, nodes.choices):
        try:
            question(name)
        except UdccalError:
            continue


def _description() -> bytes:
    return description_of(CameraModel()).encode()


_ENTRY_BYTES = struct.pack("<IIQQ20s", 0x01000002, 1 << 10, 0x10000, 4000, bytes(20)) + bytes(20)

DEVICE_TARGETS = (
    Target(
        "gencp",
        _decode,
        lambda: (
            _acknowledge(0x0801, bytes(16)),
            _acknowledge(0x0803, struct.pack("<HH", 0, 4)),
            _acknowledge(0x0805, struct.pack("<HH", 0, 500)),
            _acknowledge(0x0801, b"", 0x8004),
        ),
        256,
    ),
    Target("leader", parse_leader, lambda: (_LEADER,), 256),
    Target("trailer", parse_trailer, lambda: (_TRAILER,), 256),
    Target("chunks", _chunks, lambda: (_CHUNKS,), 512),
    Target("manifest", parse_entry, lambda: (_ENTRY_BYTES[:64],), 128),
    Target(
        "description-zip",
        lambda data: unpacked(data, 1),
        lambda: (zipped("<RegisterDescription/>"), zipped(_description().decode())),
        32768,
    ),
    Target("xml", _describe, lambda: (_description(),), 65536),
    Target("features", _change_and_describe, lambda: (bytes((0, 5, 0, 5)) * 4,), 64),
)
