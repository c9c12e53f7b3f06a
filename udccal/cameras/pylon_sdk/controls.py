"""Sets modes and settings through GenICam features, by SFNC's names or else by the older ones that end in ``Abs``."""

from __future__ import annotations

import math
from typing import Final

from udccal.cameras.checks import TEMPERATURE_PLACES, temperature_or_none
from udccal.cameras.pixel_formats import PIXEL_FORMATS
from udccal.cameras.protocol import Features, Mode, Range, Region, Settings, Trigger
from udccal.cameras.pylon_sdk.nodes import Nodes

_EXPOSURE: Final = ("ExposureTime", "ExposureTimeAbs")  # in us
_GAIN: Final = ("Gain", "GainAbs")  # in dB
_RATE: Final = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
_RATE_ENABLE: Final = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
_TEMPERATURE: Final = ("DeviceTemperature", "TemperatureAbs")  # in degrees Celsius
_US_PER_S: Final = 1e6
_NOTHING: Final = Range(0.0, 0.0)
_FRAME_START: Final = "FrameStart"
_SOFTWARE: Final = "Software"


def read_sensor(nodes: Nodes) -> Region:
    """Return the largest region without binning, cropped to whole 2 x 2 cells."""
    sides = (nodes.number("WidthMax", "SensorWidth", "Width"), nodes.number("HeightMax", "SensorHeight", "Height"))
    columns, rows = (2 * (int(side or 0) // 2) for side in sides)
    return Region(0, 0, columns, rows)


def read_features(nodes: Nodes) -> Features:
    """Return what the device can do in its current mode."""
    exposure = nodes.bounds(*_EXPOSURE) or _NOTHING
    steps = tuple(math.lcm(2, nodes.step(name)) for name in ("OffsetX", "OffsetY", "Width", "Height"))
    return Features(
        exposure_s=Range(exposure.low / _US_PER_S, exposure.high / _US_PER_S),
        gain_dB=nodes.bounds(*_GAIN) or _NOTHING,
        frame_rate_hz=nodes.bounds(*_RATE) or _NOTHING,
        pixel_formats=_formats(nodes),
        triggers=_triggers(nodes),
        region_steps=(steps[0], steps[1], steps[2], steps[3]),
    )


def read_mode(nodes: Nodes) -> Mode:
    """Return the current mode."""
    return Mode(nodes.text("PixelFormat"), _paced_rate_hz(nodes), _trigger(nodes))


def write_mode(nodes: Nodes, mode: Mode) -> None:
    """Set a mode that the features allow."""
    nodes.choose("PixelFormat", mode.pixel_format)
    can_be_free = nodes.set_flag(mode.frame_rate_hz is not None, *_RATE_ENABLE)
    fastest = nodes.bounds(*_RATE)
    if mode.frame_rate_hz is not None:
        nodes.set_number(mode.frame_rate_hz, *_RATE)
    elif fastest is not None and not can_be_free:
        nodes.set_number(fastest.high, *_RATE)
    for selector in nodes.choices("TriggerSelector"):
        if nodes.choose("TriggerSelector", selector):
            nodes.choose("TriggerMode", "Off")
    if mode.trigger is not Trigger.FREE_RUN:
        nodes.choose("TriggerSelector", _FRAME_START)
        nodes.choose("TriggerSource", _SOFTWARE if mode.trigger is Trigger.SOFTWARE else _line(nodes))
        nodes.choose("TriggerMode", "On")


def read_settings(nodes: Nodes) -> Settings:
    """Return the current settings; a device without a gain in dB is at 0 dB."""
    numbers = [int(nodes.number(name) or 0) for name in ("OffsetX", "OffsetY", "Width", "Height")]
    exposure_s = (nodes.number(*_EXPOSURE) or 0.0) / _US_PER_S
    return Settings(exposure_s, nodes.number(*_GAIN) or 0.0, Region(*numbers))


def read_temperature(nodes: Nodes) -> float | None:
    """Return the temperature in degrees Celsius, of the sensor where it can be chosen; None where there is none."""
    for selector in ("DeviceTemperatureSelector", "TemperatureSelector"):
        any(nodes.choose(selector, place) for place in TEMPERATURE_PLACES)
    found_C = nodes.number(*_TEMPERATURE)
    return None if found_C is None else temperature_or_none(found_C)


def write_settings(nodes: Nodes, settings: Settings) -> None:
    """Set settings that the features allow; a device without a gain in dB is set to its smallest gain."""
    exposure_us = settings.exposure_s * _US_PER_S
    if (exposures := nodes.bounds(*_EXPOSURE)) is not None:
        # Conversion to s and back may end an ulp outside.
        exposure_us = min(max(exposure_us, exposures.low), exposures.high)
    nodes.set_number(exposure_us, *_EXPOSURE)
    least = nodes.bounds("GainRaw")
    if not nodes.set_number(settings.gain_dB, *_GAIN) and least is not None:
        nodes.set_whole(int(least.low), "GainRaw")
    region = settings.region
    for offset, size, start, length in (
        ("OffsetX", "Width", region.x, region.columns),
        ("OffsetY", "Height", region.y, region.rows),
    ):
        nodes.set_whole(0, offset)  # makes room for any size
        nodes.set_whole(length, size)
        nodes.set_whole(start, offset)


def frame_period_s(nodes: Nodes) -> float:
    """Return the frame period in s of a paced camera; 0 when it runs as fast as it can."""
    rate_hz = _paced_rate_hz(nodes)
    return 1.0 / rate_hz if rate_hz else 0.0


def _paced_rate_hz(nodes: Nodes) -> float | None:
    """Return the rate limit in Hz; a device without a switch for it always has one."""
    return nodes.number(*_RATE) if nodes.flag(*_RATE_ENABLE) in (True, None) else None


def ticks_per_s(nodes: Nodes) -> float:
    """Return the tick of the camera's clock in s: USB3 Vision counts ns, GigE Vision gives its unit."""
    return nodes.number("GevTimestampTickFrequency") or 1e9


def _formats(nodes: Nodes) -> tuple[str, ...]:
    """Return formats with raw samples; a colour sensor's Mono formats are mixed from its colours."""
    coloured = nodes.text("PixelColorFilter").startswith("Bayer")
    known = (name for name in nodes.choices("PixelFormat") if name in PIXEL_FORMATS)
    return tuple(name for name in known if not (coloured and PIXEL_FORMATS[name].cfa == "mono"))


def _triggers(nodes: Nodes) -> tuple[Trigger, ...]:
    if _FRAME_START not in nodes.choices("TriggerSelector"):
        return (Trigger.FREE_RUN,)
    sources = nodes.choices("TriggerSource")
    software = (Trigger.SOFTWARE,) if _SOFTWARE in sources else ()
    external = (Trigger.EXTERNAL,) if any(source.startswith("Line") for source in sources) else ()
    return (Trigger.FREE_RUN, *software, *external)


def _trigger(nodes: Nodes) -> Trigger:
    if not nodes.choose("TriggerSelector", _FRAME_START) or nodes.text("TriggerMode") != "On":
        return Trigger.FREE_RUN
    return Trigger.SOFTWARE if nodes.text("TriggerSource") == _SOFTWARE else Trigger.EXTERNAL


def _line(nodes: Nodes) -> str:
    """Return the trigger line that is set already, or the first."""
    chosen = nodes.text("TriggerSource")
    return chosen if chosen.startswith("Line") else next(s for s in nodes.choices("TriggerSource") if "Line" in s)
