from __future__ import annotations

import gc
import struct
import time
import weakref
from collections.abc import Iterator

import pytest

from tests.cameras.u3v.toy_nodes import HEAD, float_register, integer_register
from udccal.cameras.protocol import Range
from udccal.cameras.u3v.description import checked_xml
from udccal.cameras.u3v.nodes import NodeMap
from udccal.errors import CameraError, CameraLost, CameraProtocolError, CameraTimeout

SENTENCE = r"Expected .* found.*\. \w+"
XML = "".join(
    (
        HEAD,
        '<Category Name="Root"><pFeature>Width</pFeature></Category>',
        '<Integer Name="Width"><pValue>W</pValue><Min>16</Min><pMax>WMax</pMax><Inc>4</Inc></Integer>',
        integer_register("W", 0),
        integer_register("WMax", 4),
        '<Float Name="ExposureTime"><pValue>E</pValue><Min>10</Min><Max>1e6</Max></Float>',
        float_register("E", 8),
        '<Enumeration Name="TriggerMode"><EnumEntry Name="Off"><Value>0</Value></EnumEntry>',
        '<EnumEntry Name="On"><Value>1</Value></EnumEntry>',
        '<EnumEntry Name="Never"><pIsAvailable>No</pIsAvailable><Value>2</Value></EnumEntry>',
        "<pValue>T</pValue></Enumeration>",
        integer_register("T", 16),
        '<Boolean Name="Flag"><pValue>F</pValue><OnValue>1</OnValue><OffValue>0</OffValue></Boolean>',
        integer_register("F", 20),
        '<Command Name="Start"><pValue>S</pValue><CommandValue>1</CommandValue></Command>',
        integer_register("S", 24, "<PollingTime>1</PollingTime>"),
        '<Integer Name="No"><Value>0</Value></Integer>',
        '<Float Name="Hidden"><pIsAvailable>No</pIsAvailable><Value>3</Value></Float>',
        '<Float Name="Fixed"><pIsLocked>One</pIsLocked><Value>3</Value></Float>',
        '<Integer Name="One"><Value>1</Value></Integer>',
        '<IntSwissKnife Name="Broken"><Formula>1/0</Formula></IntSwissKnife>',
        float_register("ChunkExposureTime", 0, "ExposurePort"),
        '<Port Name="ExposurePort"><ChunkID>A001</ChunkID></Port>',
        '<Port Name="Device"/></RegisterDescription>',
    )
)


class Memory:
    """Registers, with what may go wrong."""

    def __init__(self) -> None:
        self.content = bytearray(64)
        self.error: CameraError | None = None
        self.short = False
        self.clears_commands = True
        struct.pack_into("<IId", self.content, 0, 64, 2048, 5000.0)

    def read(self, address: int, length: int) -> bytes:
        if self.error is not None:
            raise self.error
        return bytes(self.content[address : address + length - self.short])

    def write(self, address: int, data: bytes) -> None:
        if self.error is not None:
            raise self.error
        if not (address == 24 and self.clears_commands):
            self.content[address : address + len(data)] = data


@pytest.fixture
def memory() -> Memory:
    return Memory()


@pytest.fixture
def nodes(memory: Memory) -> Iterator[NodeMap]:
    made = NodeMap(XML, memory)
    yield made
    made.close()


def test_numbers_of_both_kinds(nodes: NodeMap, memory: Memory) -> None:
    assert (nodes.number("Width"), nodes.bounds("Width"), nodes.step("Width")) == (64, Range(16.0, 2048.0), 4)
    assert (nodes.number("ExposureTime"), nodes.bounds("ExposureTime")) == (5000.0, Range(10.0, 1e6))
    nodes.set_number("Width", 128)
    nodes.set_number("ExposureTime", 1234.5)
    assert struct.unpack_from("<IId", memory.content) == (128, 2048, 1234.5)


def test_values_are_read_anew_after_refresh(nodes: NodeMap, memory: Memory) -> None:
    assert (nodes.number("Width"), nodes.bounds("Width").high) == (64, 2048)
    struct.pack_into("<II", memory.content, 0, 32, 1024)
    nodes.refresh()
    assert (nodes.number("Width"), nodes.bounds("Width").high) == (32, 1024)


def test_choices_flags_and_commands(nodes: NodeMap, memory: Memory) -> None:
    assert nodes.choices("TriggerMode") == ("Off", "On")
    nodes.choose("TriggerMode", "On")
    assert (nodes.choice("TriggerMode"), memory.content[16]) == ("On", 1)
    nodes.set_flag("Flag", True)
    assert (nodes.flag("Flag"), memory.content[20]) == (True, 1)
    nodes.execute("Start")
    memory.clears_commands = False
    with pytest.raises(CameraTimeout, match=SENTENCE):
        nodes.execute("Start")


def test_says_what_there_is(nodes: NodeMap) -> None:
    assert [nodes.has(name) for name in ("Width", "Hidden", "Fixed", "Nothing")] == [True, False, True, False]
    assert [nodes.writable(name) for name in ("Width", "Hidden", "Fixed", "Nothing")] == [True, False, False, False]
    assert nodes.first("Nothing", "Hidden", "Width", "Flag") == "Width"
    assert nodes.first("Nothing") is None


def test_chunk_features_stand_in_the_data_given(nodes: NodeMap) -> None:
    for exposure_us in (123.5, 77.0):
        data = struct.pack("<dII", exposure_us, 0xA001, 8)
        with nodes.chunks(data):
            assert nodes.has("ChunkExposureTime")
            assert nodes.number("ChunkExposureTime") == exposure_us
        assert not nodes.has("ChunkExposureTime")


@pytest.mark.parametrize(
    "refused",
    [
        lambda n: n.number("Nothing"),
        lambda n: n.set_number("Width", 66),  # not a multiple of 4
        lambda n: n.set_number("Width", 4096),
        lambda n: n.set_number("Width", -1),
        lambda n: n.set_number("Width", 1e30),
        lambda n: n.set_number("Width", float("nan")),
        lambda n: n.set_number("ExposureTime", 1.0),
        lambda n: n.set_number("Fixed", 1.0),
        lambda n: n.set_number("Hidden", 1.0),
        lambda n: n.number("Hidden"),
        lambda n: n.number("Broken"),
        lambda n: n.choose("TriggerMode", "Never"),
        lambda n: n.choose("TriggerMode", "Perhaps"),
        lambda n: n.execute("Nothing"),
        # features of another kind than the standard's
        lambda n: n.number("TriggerMode"),
        lambda n: n.choice("Width"),
        lambda n: n.choices("Root"),
        lambda n: n.choose("Flag", "On"),
        lambda n: n.flag("Width"),
        lambda n: n.set_flag("Root", True),
        lambda n: n.execute("Width"),
        lambda n: n.bounds("Flag"),
        lambda n: n.step("Root"),
    ],
    ids=range(23),
)
def test_refusals_are_sentences(nodes: NodeMap, refused: object) -> None:
    with pytest.raises(CameraError, match=SENTENCE) as caught:
        refused(nodes)  # type: ignore[operator]
    assert ".cpp" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_an_entry_that_no_description_names_is_refused(nodes: NodeMap, memory: Memory) -> None:
    memory.content[16] = 77
    nodes.refresh()
    with pytest.raises(CameraError, match=SENTENCE):
        nodes.choice("TriggerMode")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_values_that_are_no_numbers_are_refused(nodes: NodeMap, memory: Memory, value: float) -> None:
    struct.pack_into("<d", memory.content, 8, value)
    nodes.refresh()
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        nodes.number("ExposureTime")


def test_a_memory_that_answers_too_little_is_refused(nodes: NodeMap, memory: Memory) -> None:
    memory.short = True
    nodes.refresh()
    with pytest.raises(CameraError, match=SENTENCE):
        nodes.number("Width")


@pytest.mark.parametrize(
    "asked",
    [
        lambda n: n.number("Width"),
        lambda n: n.bounds("Width"),
        lambda n: n.set_number("ExposureTime", 50.0),
        lambda n: n.choose("TriggerMode", "On"),
        lambda n: n.execute("Start"),
        lambda n: n.flag("Flag"),
    ],
    ids=range(6),
)
def test_errors_of_the_memory_come_through(nodes: NodeMap, memory: Memory, asked: object) -> None:
    nodes.refresh()
    memory.error = CameraLost("Expected a camera, found none. Plug it in.")
    with pytest.raises(CameraLost):
        asked(nodes)  # type: ignore[operator]


def test_a_failed_write_is_not_remembered_after_refresh(nodes: NodeMap, memory: Memory) -> None:
    memory.error = CameraTimeout("Expected an answer, found silence. Wait.")
    with pytest.raises(CameraTimeout):
        nodes.set_number("ExposureTime", 50.0)
    memory.error = None
    nodes.refresh()
    assert nodes.number("ExposureTime") == 5000.0


@pytest.mark.parametrize(
    "xml",
    [
        "",
        "<a/>",
        XML[:-30],
        XML.replace("<pPort>Device</pPort>", "<pPort>Nowhere</pPort>"),
        XML.replace("<Formula>1/0</Formula>", "<pVariable Name='X'>Broken</pVariable><Formula>X</Formula>"),
    ],
    ids=range(5),
)
def test_refuses_descriptions_that_make_no_sense(xml: str, memory: Memory) -> None:
    with pytest.raises(CameraError, match=SENTENCE):
        NodeMap(xml, memory)


@pytest.mark.parametrize("port", ['<Integer Name="Device"><Value>1</Value></Integer>', ""])
def test_refuses_descriptions_without_a_port_to_the_device(port: str, memory: Memory) -> None:
    nodes = '<Integer Name="One"><Value>1</Value></Integer>' + port
    with pytest.raises(CameraError, match=SENTENCE):
        NodeMap(HEAD + nodes + "</RegisterDescription>", memory)


def test_nothing_of_it_stays_in_memory(memory: Memory) -> None:
    made = NodeMap(XML, memory)
    inner = weakref.ref(made._map)
    made.close()
    del made
    gc.collect()
    assert inner() is None


def test_absent_genapi_is_a_sentence(monkeypatch: pytest.MonkeyPatch, memory: Memory) -> None:
    monkeypatch.setitem(__import__("sys").modules, "genicam", None)
    with pytest.raises(CameraError, match="pip install"):
        NodeMap(XML, memory)


def test_slow_answers_do_not_draw_out_a_command(
    nodes: NodeMap, memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory.clears_commands = False
    reads: list[int] = []

    def slow(address: int, length: int) -> bytes:
        reads.append(address)
        time.sleep(0.2)
        return bytes(memory.content[address : address + length])

    monkeypatch.setattr(memory, "read", slow)
    with pytest.raises(CameraTimeout, match=SENTENCE):
        nodes.execute("Start", 0.5)
    assert len(reads) <= 5


def test_says_what_there_is_of_a_kind(nodes: NodeMap) -> None:
    assert [nodes.writable("Width", kind) for kind in ("IInteger", "IFloat", "IEnumeration")] == [True, False, False]
    assert [nodes.writable(name, "IFloat") for name in ("ExposureTime", "Hidden", "Fixed", "Nothing")] == [
        *(True, False, False, False)
    ]


def test_an_entry_and_a_variable_may_have_the_name_of_the_port(memory: Memory) -> None:
    more = (
        '<IntSwissKnife Name="Twice"><pVariable Name="Device">W</pVariable><Formula>2*Device</Formula></IntSwissKnife>'
        '<Enumeration Name="Source"><EnumEntry Name="Device"><Value>0</Value></EnumEntry>'
        "<pValue>T</pValue></Enumeration>"
    )
    nodes = NodeMap(checked_xml(XML.replace("</Reg", more + "</Reg").encode()), memory)
    try:
        assert (nodes.choice("Source"), nodes.number("Twice")) == ("Device", 128)
    finally:
        nodes.close()


def test_a_description_in_latin_1_can_be_loaded(memory: Memory) -> None:
    head = '<?xml version="1.0" encoding="ISO-8859-1"?>'
    raw = (head + XML.replace('ToolTip=""', 'ToolTip="°C µs"')).encode("latin-1")
    nodes = NodeMap(checked_xml(raw), memory)
    try:
        assert nodes.number("Width") == 64
    finally:
        nodes.close()
