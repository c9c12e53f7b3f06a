"""Sets exposure, gain and region by their SFNC names (GenICam Standard Features Naming Convention)."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Final

from udccal.cameras.checks import TEMPERATURE_PLACES, temperature_or_none
from udccal.cameras.protocol import Range, Region, Settings
from udccal.cameras.u3v.nodes import NodeMap
from udccal.errors import CameraError

_EXPOSURE: Final = ("ExposureTime", "ExposureTimeAbs")  # us; the second name is older than SFNC 1.5
_GAIN: Final = "Gain"  # dB
_TEMPERATURE: Final = "DeviceTemperature"  # degrees Celsius
_TEMPERATURE_PLACE: Final = "DeviceTemperatureSelector"
# Lowest and highest gain of a camera without one.
_NO_GAIN: Final = Range(0.0, 0.0)
_US_PER_S: Final = 1e6


def sensor_region(nodes: NodeMap) -> Region:
    """Return the whole sensor, cropped to even sizes; smaller than SensorWidth, SensorHeight while the camera bins."""
    columns = _extent(nodes, "Width", "OffsetX", "SensorWidth")
    rows = _extent(nodes, "Height", "OffsetY", "SensorHeight")
    return Region(0, 0, columns // 2 * 2, rows // 2 * 2)


def exposure_range(nodes: NodeMap) -> Range:
    """Return the shortest and longest exposure now, s."""
    bounds = nodes.bounds(_exposure_name(nodes))
    return Range(bounds.low / _US_PER_S, bounds.high / _US_PER_S)


def gain_range(nodes: NodeMap) -> Range:
    """Return the lowest and highest gain now, dB; both 0 for a camera without a gain in dB."""
    return nodes.bounds(_GAIN) if nodes.has(_GAIN) else _NO_GAIN


def region_steps(nodes: NodeMap) -> tuple[int, int, int, int]:
    """Return the steps of x, y, columns and rows of a region; even, so that the CFA pattern stays."""
    sensor = sensor_region(nodes)
    # Without an offset only 0 is possible, which is a multiple of the sensor's size as well.
    defaults = (sensor.columns, sensor.rows, sensor.columns, sensor.rows)
    names = ("OffsetX", "OffsetY", "Width", "Height")
    steps = [
        math.lcm(nodes.step(name), 2) if nodes.has(name) else default
        for name, default in zip(names, defaults, strict=True)
    ]
    return steps[0], steps[1], steps[2], steps[3]


def read_temperature(nodes: NodeMap) -> float | None:
    """Return the temperature in degrees Celsius, of the sensor where the camera lets it be chosen.

    None where the camera has none, does not give it now, or gives a number that is none: frames are good without it. A
    camera that is gone says so at the next command.
    """
    with suppress(CameraError):
        if not nodes.has(_TEMPERATURE):
            return None
        if nodes.writable(_TEMPERATURE_PLACE):
            places = nodes.choices(_TEMPERATURE_PLACE)
            if (place := next((place for place in TEMPERATURE_PLACES if place in places), None)) is not None:
                nodes.choose(_TEMPERATURE_PLACE, place)
        return temperature_or_none(nodes.number(_TEMPERATURE))
    return None


def read_settings(nodes: NodeMap) -> Settings:
    """Return the current settings."""
    gain_dB = nodes.number(_GAIN) if nodes.has(_GAIN) else 0.0
    return Settings(nodes.number(_exposure_name(nodes)) / _US_PER_S, gain_dB, read_region(nodes))


def read_region(nodes: NodeMap) -> Region:
    """Return the current region."""
    x, y = (round(nodes.number(name)) if nodes.has(name) else 0 for name in ("OffsetX", "OffsetY"))
    columns, rows = (round(nodes.number(name)) for name in ("Width", "Height"))
    return Region(x, y, columns, rows)


def apply_settings(nodes: NodeMap, settings: Settings) -> Settings:
    """Request settings; return the camera's settings afterwards, read back from it.

    Raises:
        CameraError: when one is outside what the camera can do now; nothing is set then.
    """
    _check_region(nodes, settings.region)
    check_range("a gain", "dB", settings.gain_dB, gain_range(nodes))
    before = read_region(nodes)
    _set_region(nodes, settings.region)
    # Bounds of the exposure may depend on the region.
    nodes.refresh()
    try:
        check_range("an exposure", "s", settings.exposure_s, exposure_range(nodes))
    except CameraError:
        _set_region(nodes, before)
        raise
    bounds = nodes.bounds(_exposure_name(nodes))
    # Conversion to s and back may end an ulp outside.
    nodes.set_number(_exposure_name(nodes), min(max(settings.exposure_s * _US_PER_S, bounds.low), bounds.high))
    if nodes.has(_GAIN):
        nodes.set_number(_GAIN, settings.gain_dB)
    nodes.refresh()
    return read_settings(nodes)


def check_range(what: str, unit: str, value: float | int, allowed: Range) -> None:
    """Refuse a value outside a range, or NaN.

    Raises:
        CameraError: when the value is refused.
    """
    if not allowed.low <= value <= allowed.high:
        raise CameraError(
            f"Expected {what} from {allowed.low:g} to {allowed.high:g} {unit}, found {value:g}. "
            "Ask for one in that range."
        )


def _exposure_name(nodes: NodeMap) -> str:
    name = nodes.first(*_EXPOSURE)
    if name is None:
        raise CameraError("Expected a camera with the feature ExposureTime, found none. Use another camera.")
    return name


def _extent(nodes: NodeMap, size: str, offset: str, sensor: str) -> int:
    """Return the largest size at offset 0 for any current offset: WidthMax depends on it in some cameras."""
    extent = nodes.bounds(size).high + (nodes.number(offset) if nodes.has(offset) else 0.0)
    return round(min(extent, nodes.number(sensor)) if nodes.has(sensor) else extent)


def _check_region(nodes: NodeMap, region: Region) -> None:
    sensor, steps = sensor_region(nodes), region_steps(nodes)
    values = (region.x, region.y, region.columns, region.rows)
    in_steps = all(value % step == 0 for value, step in zip(values, steps, strict=True))
    inside = (
        min(region.x, region.y) >= 0
        and min(region.columns, region.rows) > 0
        and region.x + region.columns <= sensor.columns
        and region.y + region.rows <= sensor.rows
    )
    if not (in_steps and inside):
        raise CameraError(
            f"Expected a region inside {sensor.columns} x {sensor.rows} pixels, with x, y, columns and rows multiples "
            f"of {steps[0]}, {steps[1]}, {steps[2]} and {steps[3]}, found {region.columns} x {region.rows} at "
            f"({region.x}, {region.y}). Move or resize it."
        )


def _set_region(nodes: NodeMap, region: Region) -> None:
    """Set offsets to 0 first, since size and offset bound each other."""
    if region == read_region(nodes):
        return
    offsets = (("OffsetX", region.x), ("OffsetY", region.y))
    for name, _ in offsets:
        if nodes.writable(name):
            nodes.set_number(name, 0)
    nodes.refresh()
    for name, size in (("Width", region.columns), ("Height", region.rows)):
        nodes.set_number(name, size)
    nodes.refresh()
    for name, offset in offsets:
        if nodes.has(name):
            nodes.set_number(name, offset)
