"""What kind of camera the virtual one is: all that its data sheet would say."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Speed(enum.IntEnum):
    """Speed of the link, numbered as libusb does."""

    HIGH = 3
    SUPER = 4

    @property
    def packet_size(self) -> int:
        """wMaxPacketSize of a bulk endpoint in bytes (USB 2.0 §5.8.3, USB 3.x §9.6.6)."""
        return 1024 if self is Speed.SUPER else 512

    @property
    def u3v_bit(self) -> int:
        """Bit of the supported-speed mask and of CurrentSpeed (USB3 Vision 1.0, device info descriptor and SBRM)."""
        return 1 << (2 if self is Speed.HIGH else 3)


@dataclass(frozen=True)
class CameraModel:
    """A camera's identity, sensor and limits.

    Attributes:
        columns, rows: of the sensor, px.
        cfa: top-left 2 x 2 of the sensor, e.g. ``RGGB``; ``mono`` without a filter.
        bits: of the sensor's converter; a frame source delivers samples of this many bits.
        offset_step, size_step: (x, y) increments of the region's corner and size, px.
        exposure_us: shortest and longest exposure.
        exposure_step_us: exposures are rounded down to multiples of this by the camera, without a word.
        gain_steps: highest gain, in steps of 0.1 dB.
        frame_rate_hz: slowest and fastest.
        max_transfer: longest command and acknowledge that the control channel takes, bytes.
        alignment: of the stream's transfer sizes, bytes; a power of two.
        event_interface: whether there is an event interface, which stands between control and streaming.
        chunks: whether it can append chunk data.
        temperature: whether it says its temperature.
        response_ms: longest time to an acknowledge that it promises.
    """

    vendor: str = "udccal"
    model: str = "Virtual-U3V"
    family: str = "Virtual"
    version: str = "1.0.0"
    serial: str = "V0000001"
    columns: int = 128
    rows: int = 96
    cfa: str = "RGGB"
    bits: int = 12
    offset_step: tuple[int, int] = (4, 2)
    size_step: tuple[int, int] = (8, 2)
    exposure_us: tuple[float, float] = (20.0, 10_000_000.0)
    exposure_step_us: float = 5.0
    gain_steps: int = 240
    frame_rate_hz: tuple[float, float] = (0.1, 120.0)
    max_transfer: int = 1024
    alignment: int = 1024
    event_interface: bool = True
    chunks: bool = True
    temperature: bool = True
    response_ms: int = 200

    @property
    def guid(self) -> str:
        """Device GUID: four hexadecimal digits of the vendor and eight of the device."""
        return f"1209{sum(ord(c) << (i % 24) for i, c in enumerate(self.serial)) & 0xFFFFFFFF:08X}"
