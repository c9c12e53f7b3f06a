"""What cameras do to their samples is switched off, where they can do it at all."""

from __future__ import annotations

import struct

import pytest

from tests.cameras.u3v.toy_nodes import HEAD, TAIL, Registers, boolean, enumeration, integer_register, number, size
from udccal.cameras.u3v.nodes import NodeMap
from udccal.cameras.u3v.raw_samples import send_raw_samples
from udccal.errors import CameraError

SELECTED_GAIN = (
    '<IntSwissKnife Name="GainAt"><pVariable Name="S">GainSelectorReg</pVariable><Formula>64+8*S</Formula>'
    '</IntSwissKnife><FloatReg Name="GainReg"><pAddress>GainAt</pAddress><Length>8</Length><AccessMode>RW</AccessMode>'
    "<pPort>Device</pPort><Endianess>LittleEndian</Endianess></FloatReg>"
)


def gain(low: float) -> str:
    return f'<Float Name="Gain"><pValue>GainReg</pValue><Min>{low}</Min><Max>24</Max></Float>' + SELECTED_GAIN


def gains_of(registers: Registers) -> tuple[float, ...]:
    return struct.unpack_from("<3d", registers.content, 64)


def nodes_of(*parts: str) -> tuple[NodeMap, Registers]:
    registers = Registers()
    return NodeMap(HEAD + "".join(parts) + TAIL, registers), registers


@pytest.mark.parametrize(
    ("name", "raw", "other"),
    [
        ("SequencerMode", "Off", "On"),
        ("ExposureAuto", "Off", "Continuous"),
        ("GainAuto", "Off", "Continuous"),
        ("BalanceWhiteAuto", "Off", "Continuous"),
        ("LightSourcePreset", "Off", "Daylight5000K"),
        ("BslLightSourcePreset", "Off", "Tungsten"),
        ("LightSourceSelector", "Off", "Daylight"),
        ("TestPattern", "Off", "GreyHorizontalRamp"),
        ("BslColorSpace", "Off", "sRgb"),
        ("ColorSpace", "RGB", "sRGB"),
        ("ExposureMode", "Timed", "TriggerWidth"),
        ("AcquisitionMode", "Continuous", "SingleFrame"),
        ("BinningHorizontalMode", "Sum", "Average"),
    ],
)
def test_choices(name: str, raw: str, other: str) -> None:
    nodes, registers = nodes_of(enumeration(name, 0, **{other: 5, raw: 7}))
    registers.set_uint(0, 5)
    send_raw_samples(nodes)
    assert registers.uint(0) == 7
    assert nodes.choice(name) == raw


@pytest.mark.parametrize(
    "name", ["GammaEnable", "LUTEnable", "ColorTransformationEnable", "ReverseX", "ReverseY", "CenterX", "CenterY"]
)
def test_switches(name: str) -> None:
    nodes, registers = nodes_of(boolean(name, 0))
    registers.set_uint(0, 1)
    send_raw_samples(nodes)
    assert registers.uint(0) == 0


@pytest.mark.parametrize("name", ["BinningHorizontal", "BinningVertical", "DecimationHorizontal", "DecimationVertical"])
def test_nothing_is_binned_or_skipped(name: str) -> None:
    nodes, registers = nodes_of(size(name, 0, 1, 4, 1))
    registers.set_uint(0, 4)
    send_raw_samples(nodes)
    assert registers.uint(0) == 1


def test_gamma_is_1() -> None:
    nodes, registers = nodes_of(number("Gamma", 0, 0.0, 4.0))
    struct.pack_into("<d", registers.content, 0, 0.45)
    send_raw_samples(nodes)
    assert struct.unpack_from("<d", registers.content) == (1.0,)


@pytest.mark.parametrize("name", ["BalanceRatio", "BalanceRatioAbs"])
def test_every_colour_has_the_same_gain(name: str) -> None:
    ratio = f'<Float Name="{name}"><pValue>GainReg</pValue><Min>0.5</Min><Max>8</Max></Float>'
    selected = SELECTED_GAIN.replace("GainSelectorReg", "BalanceRatioSelectorReg")
    selector = enumeration("BalanceRatioSelector", 0, Red=0, Green=1, Blue=2)
    nodes, registers = nodes_of(selector, ratio, selected)
    struct.pack_into("<3d", registers.content, 64, 1.8, 1.1, 2.2)
    send_raw_samples(nodes)
    assert gains_of(registers) == (1.0, 1.0, 1.0)


def test_ratios_in_steps_of_the_cameras_own_stay() -> None:
    nodes, registers = nodes_of(
        enumeration("BalanceRatioSelector", 0, Red=0, Green=1, Blue=2), size("BalanceRatio", 8, 0, 255, 1)
    )
    registers.set_uint(8, 64)
    send_raw_samples(nodes)
    assert registers.uint(8) == 64


@pytest.mark.parametrize("low", [-6.0, 0.0, 3.0])
@pytest.mark.parametrize(("selected", "index"), [("All", 0), ("AnalogAll", 2)])
def test_a_digital_gain_that_was_left_over_goes(selected: str, index: int, low: float) -> None:
    nodes, registers = nodes_of(enumeration("GainSelector", 0, DigitalAll=1, **{selected: index}), gain(low))
    registers.set_uint(0, 1)
    struct.pack_into("<3d", registers.content, 64, 7.0, 12.0, 9.0)
    send_raw_samples(nodes)
    assert registers.uint(0) == index
    assert gains_of(registers) == (7.0, max(0.0, low), 9.0)


def test_all_is_preferred_to_analog() -> None:
    nodes, registers = nodes_of(enumeration("GainSelector", 0, AnalogAll=2, All=3))
    registers.set_uint(0, 2)
    send_raw_samples(nodes)
    assert registers.uint(0) == 3


def test_a_digital_gain_that_is_the_only_one_stays() -> None:
    nodes, registers = nodes_of(enumeration("GainSelector", 0, DigitalAll=1), gain(0.0))
    registers.set_uint(0, 1)
    struct.pack_into("<3d", registers.content, 64, 7.0, 12.0, 9.0)
    send_raw_samples(nodes)
    assert gains_of(registers) == (7.0, 12.0, 9.0)


def test_what_is_fixed_absent_or_of_another_kind_is_passed_over() -> None:
    fixed = (
        '<Integer Name="One"><Value>1</Value></Integer>'
        '<Float Name="Gamma"><pIsLocked>One</pIsLocked><Value>2</Value></Float>'
    )
    nodes, registers = nodes_of(
        fixed,
        enumeration("LightSourcePreset", 0, Daylight=1),  # without Off
        integer_register("TestPattern", 4),
        number("ReverseX", 8, 0.0, 1.0),
        enumeration("BinningHorizontal", 16, One=1, Two=2),
    )
    before = bytes(registers.content)
    send_raw_samples(nodes)
    assert (registers.written, bytes(registers.content)) == ([], before)


def test_a_camera_that_cannot_send_raw_samples_is_refused() -> None:
    nodes, _ = nodes_of(size("BinningVertical", 0, 2, 4, 1))
    with pytest.raises(CameraError, match="BinningVertical"):
        send_raw_samples(nodes)
