"""Refusals that all backends share: settings and modes that a camera does not have, and use while closed."""

from __future__ import annotations

from udccal.cameras.protocol import Features, Mode, Range, Region, Settings
from udccal.errors import CameraError

# What may be the temperature of a camera: not below absolute zero, and not of an oven.
COLDEST_C, HOTTEST_C = -273.15, 500.0
# GenICam's places of DeviceTemperatureSelector that count, the best first; a camera without them measures elsewhere.
TEMPERATURE_PLACES = ("Sensor", "Sensorboard")


def check_settings(settings: Settings, features: Features, sensor: Region) -> None:
    """Refuse an exposure, gain or region that a camera does not have; NaN is outside every range.

    Raises:
        CameraError: with the bounds.
    """
    _check_range("an exposure in s", settings.exposure_s, features.exposure_s)
    _check_range("a gain in dB", settings.gain_dB, features.gain_dB)
    check_region(settings.region, sensor, features.region_steps)


def temperature_or_none(found_C: float) -> float | None:
    """Return a temperature, or None for a number that is none: a camera's wrong reading must not end a capture."""
    return found_C if COLDEST_C <= found_C <= HOTTEST_C else None


def check_region(region: Region, sensor: Region, steps: tuple[int, int, int, int]) -> None:
    """Refuse a region that is empty, reaches beyond the sensor, or is not on its steps (x, y, columns, rows).

    Raises:
        CameraError: with the sensor's size and the steps.
    """
    numbers = (region.x, region.y, region.columns, region.rows)
    across = region.x >= 0 and region.columns > 0 and region.x + region.columns <= sensor.columns
    down = region.y >= 0 and region.rows > 0 and region.y + region.rows <= sensor.rows
    if not (across and down) or any(number % step for number, step in zip(numbers, steps, strict=True)):
        raise CameraError(
            f"Expected a region on even coordinates inside {sensor.columns} x {sensor.rows} pixels (x, y, columns and "
            f"rows multiples of {', '.join(map(str, steps))}), found {region.columns} x {region.rows} at "
            f"({region.x}, {region.y}). Move or shrink it."
        )


def check_mode(mode: Mode, features: Features) -> None:
    """Refuse a pixel format, frame rate or trigger that a camera does not have.

    Raises:
        CameraError: with what it has.
    """
    if mode.pixel_format not in features.pixel_formats:
        raise CameraError(
            f"Expected one of the camera's pixel formats {', '.join(features.pixel_formats)}, found "
            f"{mode.pixel_format[:40]!r}. Choose one of these."
        )
    if mode.frame_rate_hz is not None:
        _check_range("a frame rate in Hz", mode.frame_rate_hz, features.frame_rate_hz)
    if mode.trigger not in features.triggers:
        raise CameraError(
            f"Expected a trigger that the camera has ({', '.join(features.triggers)}), found {mode.trigger}. "
            "Choose one of these."
        )


def not_open() -> CameraError:
    """Return the error of a camera that is used while closed."""
    return CameraError("Expected an open camera, found it closed. Use it in a 'with' statement.")


def superseded() -> CameraError:
    """Return the error of a stream that is read after its camera was closed or began another stream."""
    return CameraError(
        "Expected frames of the camera's current stream, found that it was closed or began another one. "
        "Read one stream at a time, inside the 'with' statement."
    )


def _check_range(what: str, value: float, bounds: Range) -> None:
    if not bounds.low <= value <= bounds.high:
        raise CameraError(
            f"Expected {what} from {bounds.low:g} to {bounds.high:g}, found {value:g}. Ask for one in that range."
        )
