"""Reads exposure, gain and time of each frame from its chunk data, by SFNC's Chunk Data Control."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

from udccal.cameras.u3v.nodes import NodeMap
from udccal.errors import CameraError, CameraLost, CameraProtocolError, CameraTimeout

_WANTED: Final = ("ExposureTime", "Gain", "Timestamp")
_EXPOSURE: Final = "ChunkExposureTime"  # us
_GAIN: Final = "ChunkGain"  # dB
_TIMESTAMP: Final = "ChunkTimestamp"
_NS: Final = 1e-9


@final
@dataclass(frozen=True)
class ChunkValues:
    """Values in one frame's chunks; None for those that are missing."""

    exposure_s: float | None
    gain_dB: float | None
    timestamp_s: float | None


def enable_chunks(nodes: NodeMap) -> bool:
    """Ask the camera to send exposure, gain and time with each frame; return whether it sends any chunks."""
    if not nodes.writable("ChunkModeActive"):
        return nodes.has("ChunkModeActive") and nodes.flag("ChunkModeActive")
    nodes.set_flag("ChunkModeActive", True)
    nodes.refresh()
    selectors = nodes.choices("ChunkSelector") if nodes.has("ChunkSelector") else ()
    for selector in set(_WANTED) & set(selectors):
        nodes.choose("ChunkSelector", selector)
        nodes.refresh()
        if nodes.writable("ChunkEnable"):
            nodes.set_flag("ChunkEnable", True)
    nodes.refresh()
    return nodes.flag("ChunkModeActive")


def tick_s(nodes: NodeMap) -> float:
    """Return the tick of ChunkTimestamp in s: USB3 Vision counts ns, older cameras may count other units."""
    if nodes.has("GevTimestampTickFrequency"):
        frequency_hz = nodes.number("GevTimestampTickFrequency")
        if frequency_hz > 0.0:
            return 1.0 / frequency_hz
    return _NS


def read_chunks(nodes: NodeMap, data: bytes, tick: float) -> ChunkValues:
    """Return the values in a valid sequence of chunks.

    Raises:
        CameraProtocolError: when a chunk is too short for its value, or a value is invalid.
        CameraLost, CameraTimeout: when the description asks the camera itself, which is gone or silent.
    """
    try:
        with nodes.chunks(data):
            exposure_us, gain_dB, ticks = (
                nodes.number(name) if nodes.has(name) else None for name in (_EXPOSURE, _GAIN, _TIMESTAMP)
            )
    except (CameraLost, CameraTimeout):
        raise
    except CameraError as error:
        raise CameraProtocolError(
            f"Expected chunks that fit the camera's description, found: {error} Update its firmware."
        ) from error
    if (exposure_us is not None and exposure_us <= 0.0) or (ticks is not None and ticks < 0.0):
        raise CameraProtocolError(
            f"Expected an exposure and a time in the chunks, found {exposure_us} us at {ticks}. Update the firmware."
        )
    exposure_s = None if exposure_us is None else exposure_us / 1e6
    return ChunkValues(exposure_s, gain_dB, None if ticks is None else tick * ticks)
