"""Sets pixel format, frame rate and trigger by their SFNC names, and reads all that a camera can do."""

from __future__ import annotations

from typing import Final

from udccal.cameras.pixel_formats import PIXEL_FORMATS, PixelFormat, pixel_format
from udccal.cameras.protocol import Features, Mode, Range, Trigger
from udccal.cameras.u3v.nodes import NodeMap
from udccal.cameras.u3v.settings import check_range, exposure_range, gain_range, region_steps
from udccal.errors import CameraError, CameraProtocolError

# Names before SFNC 2.0 come second.
_RATE: Final = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
_RATE_ENABLE: Final = ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled")
_RESULTING_RATE: Final = ("ResultingFrameRate", "AcquisitionResultingFrameRate", "ResultingFrameRateAbs")
# Some cameras start each frame as a burst of one.
_FRAME_START: Final = ("FrameStart", "FrameBurstStart")
_BURST: Final = "AcquisitionBurstFrameCount"
_SOFTWARE: Final = "Software"
_LINE: Final = "Line"


def read_features(nodes: NodeMap) -> Features:
    """Return what the camera can do in its current mode."""
    return Features(
        exposure_s=exposure_range(nodes),
        gain_dB=gain_range(nodes),
        frame_rate_hz=_rate_range(nodes),
        pixel_formats=_raw_formats(nodes),
        triggers=_triggers(nodes),
        region_steps=region_steps(nodes),
    )


def read_format(nodes: NodeMap) -> PixelFormat:
    """Return the current pixel format.

    Raises:
        CameraError: when udccal cannot unpack it.
    """
    return pixel_format(nodes.choice("PixelFormat"))


def choose_known_format(nodes: NodeMap) -> None:
    """Keep the pixel format if it holds raw samples; else set the one with most bits.

    Raises:
        CameraError: when the camera has none that udccal can unpack.
    """
    names = _raw_formats(nodes)
    if nodes.choice("PixelFormat") in names:
        return
    known = [PIXEL_FORMATS[name] for name in names]
    if not known:
        raise CameraError(
            f"Expected a camera with a Mono or Bayer pixel format, found {', '.join(nodes.choices('PixelFormat'))}. "
            "Use another camera."
        )
    nodes.choose("PixelFormat", max(known, key=lambda f: (f.bits, f.packed)).name)
    nodes.refresh()


def read_mode(nodes: NodeMap) -> Mode:
    """Return the current mode.

    Raises:
        CameraProtocolError: when its frame rate is 0 Hz or less.
    """
    enable, rate = nodes.first(*_RATE_ENABLE), nodes.first(*_RATE)
    limited = rate is not None and (enable is None or nodes.flag(enable))
    rate_hz = nodes.number(rate) if limited and rate is not None else None
    if rate_hz is not None and rate_hz <= 0:
        raise CameraProtocolError(
            f"Expected a frame rate above 0 Hz, found {rate_hz:g} in {rate}. Set another one with its maker's program."
        )
    return Mode(nodes.choice("PixelFormat"), rate_hz, _read_trigger(nodes))


def apply_mode(nodes: NodeMap, mode: Mode) -> Mode:
    """Request a mode; return the camera's mode afterwards, read back from it.

    Raises:
        CameraError: when the camera or udccal does not support a part of it.
    """
    _check_choice("a pixel format", mode.pixel_format, _raw_formats(nodes))
    _check_choice("a trigger", mode.trigger, _triggers(nodes))
    nodes.choose("PixelFormat", mode.pixel_format)
    _set_trigger(nodes, mode.trigger)
    nodes.refresh()
    _set_rate(nodes, mode.frame_rate_hz)
    nodes.refresh()
    return read_mode(nodes)


def _check_choice(what: str, asked: str, allowed: tuple[str, ...]) -> None:
    if asked not in allowed:
        raise CameraError(f"Expected {what} out of {', '.join(allowed)}, found {asked[:40]!r}. Choose one of them.")


def _raw_formats(nodes: NodeMap) -> tuple[str, ...]:
    """Return formats that udccal can unpack; a colour sensor's Mono formats are mixed from its colours."""
    known = tuple(name for name in nodes.choices("PixelFormat") if name in PIXEL_FORMATS)
    return tuple(name for name in known if PIXEL_FORMATS[name].cfa != "mono") or known


def _rate_range(nodes: NodeMap) -> Range:
    name = nodes.first(*_RATE)
    if name is not None:
        return nodes.bounds(name)
    resulting = nodes.first(*_RESULTING_RATE)
    rate_hz = nodes.number(resulting) if resulting is not None else 0.0
    return Range(rate_hz, rate_hz)


def _set_rate(nodes: NodeMap, rate_hz: float | None) -> None:
    enable = nodes.first(*_RATE_ENABLE)
    if enable is not None:
        nodes.set_flag(enable, rate_hz is not None)
        nodes.refresh()
    name = nodes.first(*_RATE)
    if rate_hz is not None:
        check_range("a frame rate", "Hz", rate_hz, _rate_range(nodes))
    if name is not None and (rate_hz is not None or enable is None) and nodes.writable(name):
        nodes.set_number(name, nodes.bounds(name).high if rate_hz is None else rate_hz)


def _triggers(nodes: NodeMap) -> tuple[Trigger, ...]:
    if not nodes.has("TriggerMode") or not nodes.has("TriggerSource"):
        return (Trigger.FREE_RUN,)
    if nodes.has("TriggerSelector") and _frame_start(nodes) is None:
        return (Trigger.FREE_RUN,)
    sources = nodes.choices("TriggerSource")
    triggers = [Trigger.FREE_RUN]
    if _SOFTWARE in sources:
        triggers.append(Trigger.SOFTWARE)
    if any(source.startswith(_LINE) for source in sources):
        triggers.append(Trigger.EXTERNAL)
    return tuple(triggers)


def _frame_start(nodes: NodeMap) -> str | None:
    """Return the selector's name for the trigger that starts a frame; None when there is none."""
    selectors = nodes.choices("TriggerSelector")
    return next((name for name in _FRAME_START if name in selectors), None)


def _select_frame_start(nodes: NodeMap) -> None:
    if not nodes.writable("TriggerSelector"):
        return
    start = _frame_start(nodes)
    if start is not None and nodes.choice("TriggerSelector") != start:
        nodes.choose("TriggerSelector", start)
        nodes.refresh()


def _read_trigger(nodes: NodeMap) -> Trigger:
    if not nodes.has("TriggerMode"):
        return Trigger.FREE_RUN
    _select_frame_start(nodes)
    if nodes.choice("TriggerMode") == "Off":
        return Trigger.FREE_RUN
    return Trigger.SOFTWARE if nodes.choice("TriggerSource") == _SOFTWARE else Trigger.EXTERNAL


def _set_trigger(nodes: NodeMap, trigger: Trigger) -> None:
    """Switch every kind of trigger off, then the one that starts a frame on where it is wanted."""
    if not nodes.has("TriggerMode"):
        return
    for selector in nodes.choices("TriggerSelector") if nodes.writable("TriggerSelector") else ():
        nodes.choose("TriggerSelector", selector)
        nodes.refresh()
        if nodes.writable("TriggerMode"):
            nodes.choose("TriggerMode", "Off")
    _select_frame_start(nodes)
    nodes.choose("TriggerMode", "Off")
    if trigger is not Trigger.FREE_RUN:
        if nodes.writable(_BURST):
            nodes.set_number(_BURST, 1)
        nodes.choose("TriggerSource", _source(nodes, trigger))
        nodes.choose("TriggerMode", "On")


def _source(nodes: NodeMap, trigger: Trigger) -> str:
    """Keep an input that is chosen already, so that it can be set before with the maker's program."""
    if trigger is Trigger.SOFTWARE:
        return _SOFTWARE
    present = nodes.choice("TriggerSource")
    lines = [s for s in nodes.choices("TriggerSource") if s.startswith(_LINE)]
    return present if present in lines else lines[0]
