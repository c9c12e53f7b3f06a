"""Settings and modes on other descriptions than the virtual camera's: older names, selectors, missing features."""

from __future__ import annotations

import struct

import pytest

from tests.cameras.u3v.toy_nodes import HEAD, TAIL, Registers, boolean, enumeration, integer_register, number, size
from udccal.cameras.protocol import Mode, Range, Region, Settings, Trigger
from udccal.cameras.u3v.chunk_values import enable_chunks, tick_s
from udccal.cameras.u3v.mode import apply_mode, choose_known_format, read_features, read_mode
from udccal.cameras.u3v.nodes import NodeMap
from udccal.cameras.u3v.raw_samples import send_raw_samples
from udccal.cameras.u3v.settings import apply_settings, read_settings, read_temperature, sensor_region
from udccal.errors import CameraError

SENTENCE = r"Expected .* found .*\. \w+"

SIZES = size("Width", 0, 16, 101, 1) + size("Height", 4, 2, 80, 2)
EXPOSURE = number("ExposureTimeAbs", 8, 20.0, 1e6)
FORMATS = enumeration("PixelFormat", 16, Mono8=0x01080001, Mono12=0x01100005, RGB8=0x02180014, Mono12p=0x010C0047)
RATE = boolean("AcquisitionFrameRateEnable", 24) + number("AcquisitionFrameRateAbs", 32, 0.5, 90.0)
# One TriggerMode and TriggerSource for each of two selectors, 8 bytes apart.
TRIGGER = (
    enumeration("TriggerSelector", 40, AcquisitionStart=0, FrameStart=1)
    + '<IntSwissKnife Name="ModeAt"><pVariable Name="S">TriggerSelectorReg</pVariable>'
    "<Formula>48+8*S</Formula></IntSwissKnife>"
    + enumeration("TriggerMode", "<pAddress>ModeAt</pAddress>", Off=0, On=1)
    + enumeration("TriggerSource", 64, Software=0, Line1=1, Line2=2, Action1=3)
)
GAIN = (
    enumeration("GainSelector", 72, DigitalAll=0, AnalogAll=1)
    + number("Gain", 80, 0.0, 12.0)
    + enumeration("GainAuto", 88, Off=0, Continuous=1)
    + enumeration("ExposureMode", 92, TriggerWidth=0, Timed=1)
)


def nodes_of(*parts: str, region: tuple[int, int] = (100, 80)) -> tuple[NodeMap, Registers]:
    registers = Registers()
    struct.pack_into("<IId", registers.content, 0, *region, 5000.0)
    registers.set_uint(16, 0x01080001)
    struct.pack_into("<d", registers.content, 32, 30.0)
    return NodeMap(HEAD + "".join((SIZES, EXPOSURE, FORMATS, *parts)) + TAIL, registers), registers


def test_older_names_without_offsets_and_gain() -> None:
    nodes, registers = nodes_of()
    assert sensor_region(nodes) == Region(0, 0, 100, 80)  # of 101 columns
    features = read_features(nodes)
    assert (features.exposure_s, features.gain_dB) == (Range(20e-6, 1.0), Range(0.0, 0.0))
    assert (features.frame_rate_hz, features.triggers) == (Range(0.0, 0.0), (Trigger.FREE_RUN,))
    assert features.pixel_formats == ("Mono8", "Mono12", "Mono12p")
    assert features.region_steps == (100, 80, 2, 2)
    asked = Settings(2e-3, 0.0, Region(0, 0, 64, 40))
    assert apply_settings(nodes, asked) == asked
    assert struct.unpack_from("<IId", registers.content) == (64, 40, 2000.0)


@pytest.mark.parametrize(
    "settings", [Settings(2e-3, 1.0, Region(0, 0, 64, 40)), Settings(2e-3, 0.0, Region(2, 0, 64, 40))]
)
def test_refuses_gain_and_offset_that_it_does_not_have(settings: Settings) -> None:
    with pytest.raises(CameraError, match=SENTENCE):
        apply_settings(nodes_of()[0], settings)


# Two temperatures, 8 bytes apart, of which the selector shows one.
WARMTH = (
    enumeration("DeviceTemperatureSelector", 96, Coreboard=0, Sensor=1)
    + '<IntSwissKnife Name="WarmthAt"><pVariable Name="S">DeviceTemperatureSelectorReg</pVariable>'
    "<Formula>104+8*S</Formula></IntSwissKnife>"
    + number("DeviceTemperature", 104, -50.0, 200.0).replace("<Address>104</Address>", "<pAddress>WarmthAt</pAddress>")
)


def test_the_temperature_is_that_of_the_sensor_where_it_can_be_chosen() -> None:
    nodes, registers = nodes_of(WARMTH)
    struct.pack_into("<dd", registers.content, 104, 50.0, 38.0)
    assert read_temperature(nodes) == 38.0
    assert registers.uint(96) == 1


@pytest.mark.parametrize("found_C", [float("nan"), float("inf"), 1e9, -300.0])
def test_a_temperature_that_is_none_counts_as_not_said(found_C: float) -> None:
    nodes, registers = nodes_of(number("DeviceTemperature", 104, -50.0, 200.0))
    struct.pack_into("<d", registers.content, 104, found_C)
    assert read_temperature(nodes) is None
    assert read_temperature(nodes_of()[0]) is None


def test_a_camera_without_exposure_is_refused() -> None:
    registers = Registers()
    nodes = NodeMap(HEAD + SIZES + FORMATS + TAIL, registers)
    with pytest.raises(CameraError, match="ExposureTime"):
        read_settings(nodes)


def test_takes_control_of_exposure_and_gain() -> None:
    nodes, registers = nodes_of(GAIN)
    registers.set_uint(88, 1)
    send_raw_samples(nodes)
    assert [registers.uint(address) for address in (72, 88, 92)] == [1, 0, 1]
    assert read_features(nodes).gain_dB == Range(0.0, 12.0)


def test_a_region_that_stays_is_not_written() -> None:
    nodes, registers = nodes_of()
    apply_settings(nodes, Settings(2e-3, 0.0, Region(0, 0, 64, 40)))
    registers.written.clear()
    apply_settings(nodes, Settings(3e-3, 0.0, Region(0, 0, 64, 40)))
    assert registers.written == [8]


def test_a_rate_with_a_switch() -> None:
    nodes, registers = nodes_of(RATE)
    assert read_mode(nodes) == Mode("Mono8", None)
    assert apply_mode(nodes, Mode("Mono12p", 45.0)) == Mode("Mono12p", 45.0)
    assert (registers.uint(24), struct.unpack_from("<d", registers.content, 32)[0]) == (1, 45.0)
    assert apply_mode(nodes, Mode("Mono12p")) == Mode("Mono12p", None)
    assert registers.uint(24) == 0
    with pytest.raises(CameraError, match=SENTENCE):
        apply_mode(nodes, Mode("Mono8", 91.0))


def test_a_rate_without_a_switch_is_the_fastest_when_none_is_asked_for() -> None:
    nodes, _ = nodes_of(number("AcquisitionFrameRate", 32, 0.5, 60.0))
    assert apply_mode(nodes, Mode("Mono8", 10.0)).frame_rate_hz == 10.0
    assert apply_mode(nodes, Mode("Mono8")).frame_rate_hz == 60.0


def test_a_camera_that_only_says_its_rate() -> None:
    nodes, _ = nodes_of(number("ResultingFrameRate", 32, 0.5, 60.0))
    assert read_features(nodes).frame_rate_hz == Range(30.0, 30.0)
    with pytest.raises(CameraError, match=SENTENCE):
        apply_mode(nodes, Mode("Mono8", 20.0))


def test_only_the_trigger_of_a_frame_is_on() -> None:
    nodes, registers = nodes_of(TRIGGER)
    registers.set_uint(48, 1)  # of AcquisitionStart, left on by another program
    assert read_features(nodes).triggers == (Trigger.FREE_RUN, Trigger.SOFTWARE, Trigger.EXTERNAL)
    assert apply_mode(nodes, Mode("Mono8", None, Trigger.SOFTWARE)).trigger is Trigger.SOFTWARE
    assert [registers.uint(address) for address in (48, 56, 64)] == [0, 1, 0]
    assert apply_mode(nodes, Mode("Mono8", None, Trigger.EXTERNAL)).trigger is Trigger.EXTERNAL
    assert [registers.uint(address) for address in (48, 56, 64)] == [0, 1, 1]
    assert apply_mode(nodes, Mode("Mono8")).trigger is Trigger.FREE_RUN
    assert [registers.uint(address) for address in (48, 56)] == [0, 0]


@pytest.mark.parametrize(("set_beforehand", "kept"), [(2, 2), (1, 1), (0, 1), (3, 1)])
def test_an_input_that_was_chosen_beforehand_stays(set_beforehand: int, kept: int) -> None:
    nodes, registers = nodes_of(TRIGGER)
    registers.set_uint(64, set_beforehand)
    apply_mode(nodes, Mode("Mono8", None, Trigger.EXTERNAL))
    assert registers.uint(64) == kept


def test_refuses_a_trigger_that_it_does_not_have() -> None:
    with pytest.raises(CameraError, match="free-run"):
        apply_mode(nodes_of()[0], Mode("Mono8", None, Trigger.SOFTWARE))


def test_a_format_that_cannot_be_unpacked_gives_way_to_the_deepest_that_can() -> None:
    nodes, registers = nodes_of()
    choose_known_format(nodes)
    assert registers.uint(16) == 0x01080001
    registers.set_uint(16, 0x02180014)
    nodes.refresh()
    choose_known_format(nodes)
    assert registers.uint(16) == 0x010C0047


def test_a_camera_without_a_known_format_is_refused() -> None:
    registers = Registers()
    registers.set_uint(16, 1)
    nodes = NodeMap(HEAD + SIZES + enumeration("PixelFormat", 16, RGB8=1, YUV422=2) + TAIL, registers)
    with pytest.raises(CameraError, match="RGB8, YUV422"):
        choose_known_format(nodes)


def test_chunks_are_enabled_one_by_one() -> None:
    selector = enumeration("ChunkSelector", 100, Image=0, ExposureTime=1, Timestamp=2, CounterValue=3)
    at = (
        '<IntSwissKnife Name="EnableAt"><pVariable Name="S">ChunkSelectorReg</pVariable>'
        "<Formula>112+4*S</Formula></IntSwissKnife>"
    )
    enable = (
        '<Boolean Name="ChunkEnable"><pValue>EnableReg</pValue><OnValue>1</OnValue><OffValue>0</OffValue></Boolean>'
    )
    register = integer_register("EnableReg", "<pAddress>EnableAt</pAddress>")
    nodes, registers = nodes_of(boolean("ChunkModeActive", 96), selector, at, enable, register)
    assert enable_chunks(nodes)
    assert registers.uint(96) == 1
    assert [registers.uint(112 + 4 * i) for i in range(4)] == [0, 1, 1, 0]
    assert not enable_chunks(nodes_of()[0])


def test_ticks_are_ns_unless_the_camera_says_otherwise() -> None:
    assert tick_s(nodes_of()[0]) == 1e-9
    nodes, registers = nodes_of(size("GevTimestampTickFrequency", 120, 0, 1 << 30, 1))
    assert tick_s(nodes) == 1e-9
    registers.set_uint(120, 125_000_000)
    nodes.refresh()
    assert tick_s(nodes) == 8e-9


def test_a_colour_sensor_offers_its_mosaic_alone() -> None:
    formats = enumeration("PixelFormat", 16, Mono8=0x01080001, BayerRG8=0x01080009, BayerRG12=0x01100011)
    registers = Registers()
    registers.set_uint(16, 0x01080001)
    nodes = NodeMap(HEAD + SIZES + EXPOSURE + formats + TAIL, registers)
    assert read_features(nodes).pixel_formats == ("BayerRG8", "BayerRG12")
    with pytest.raises(CameraError, match="BayerRG8, BayerRG12"):
        apply_mode(nodes, Mode("Mono8"))
    choose_known_format(nodes)
    assert registers.uint(16) == 0x01100011


def fixed(feature: str) -> str:
    """A feature whose register can only be read."""
    return feature.replace("<AccessMode>RW</AccessMode>", "<AccessMode>RO</AccessMode>")


@pytest.mark.parametrize("feature", [fixed(number("Gain", 80, 0.0, 0.0)), fixed(size("OffsetX", 96, 0, 0, 1))])
def test_fixed_features_are_left_as_they_are(feature: str) -> None:
    nodes, _ = nodes_of(feature)
    asked = Settings(2e-3, 0.0, Region(0, 0, 64, 40))
    assert apply_settings(nodes, asked) == asked


def test_a_fixed_trigger_and_rate_are_left_as_they_are() -> None:
    trigger = fixed(enumeration("TriggerMode", 48, Off=0, On=1))
    rate = fixed(boolean("AcquisitionFrameRateEnable", 24)) + number("AcquisitionFrameRate", 32, 0.5, 60.0)
    nodes, _ = nodes_of(trigger, rate)
    assert apply_mode(nodes, Mode("Mono12")) == Mode("Mono12")
    with pytest.raises(CameraError, match=r"not writable\. Ask"):
        apply_mode(nodes, Mode("Mono12", 20.0))


def test_a_refused_exposure_leaves_the_region_as_it_was() -> None:
    nodes, _ = nodes_of()
    before = apply_settings(nodes, Settings(2e-3, 0.0, Region(0, 0, 64, 40)))
    for exposure_s, gain_dB in ((99.0, 0.0), (2e-3, 9.0)):
        with pytest.raises(CameraError, match=SENTENCE):
            apply_settings(nodes, Settings(exposure_s, gain_dB, Region(0, 0, 32, 20)))
        nodes.refresh()
        assert read_settings(nodes) == before


def test_a_burst_of_one_stands_for_a_frame() -> None:
    burst = (
        enumeration("TriggerSelector", 40, FrameBurstStart=0)
        + enumeration("TriggerMode", 48, Off=0, On=1)
        + enumeration("TriggerSource", 64, Software=0, Line1=1)
        + size("AcquisitionBurstFrameCount", 68, 1, 100, 1)
    )
    nodes, registers = nodes_of(burst)
    registers.set_uint(68, 5)
    assert read_features(nodes).triggers == (Trigger.FREE_RUN, Trigger.SOFTWARE, Trigger.EXTERNAL)
    assert apply_mode(nodes, Mode("Mono8")) == Mode("Mono8")
    assert apply_mode(nodes, Mode("Mono8", None, Trigger.SOFTWARE)).trigger is Trigger.SOFTWARE
    assert (registers.uint(48), registers.uint(68)) == (1, 1)


def test_a_camera_without_a_trigger_of_frames_runs_free() -> None:
    other = (
        enumeration("TriggerSelector", 40, AcquisitionStart=0)
        + enumeration("TriggerMode", 48, Off=0, On=1)
        + enumeration("TriggerSource", 64, Software=0, Line1=1)
    )
    nodes, registers = nodes_of(other)
    registers.set_uint(48, 1)
    assert read_features(nodes).triggers == (Trigger.FREE_RUN,)
    assert apply_mode(nodes, Mode("Mono8")) == Mode("Mono8")
    assert registers.uint(48) == 0


def test_chunks_without_a_selector_are_taken_as_they_come() -> None:
    nodes, registers = nodes_of(boolean("ChunkModeActive", 96))
    assert enable_chunks(nodes)
    assert registers.uint(96) == 1
