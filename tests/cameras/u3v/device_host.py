"""The virtual camera as a host without a driver sees it, for its own tests."""

from __future__ import annotations

import struct

import numpy as np
import usb.control
import usb.core
import usb.util

from tests.virtual_u3v import registers as at
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.pixel_formats import PixelFormat
from tests.virtual_u3v.raw_host import RawFrame, RawHost
from tests.virtual_u3v.sources import Exposure


def host_of(camera: VirtualCamera) -> RawHost:
    device = usb.core.find(backend=VirtualBackend([camera]))
    assert device is not None
    return RawHost(device)


def exposure(frame: RawFrame, camera: VirtualCamera, exposure_us: float = 7000.0, gain_steps: int = 0) -> Exposure:
    columns, rows, x, y = struct.unpack_from("<4I", frame.leader, 32)
    block_id = frame.block_ids[0]
    return Exposure(block_id, frame.timestamp_ns, exposure_us, gain_steps, camera.model.bits, x, y, columns, rows)


def unpacked(data: bytes, pixel_format: PixelFormat, shape: tuple[int, int]) -> np.ndarray:
    """Samples bit by bit, little endian, for formats of any width: slow and obvious."""
    bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little").reshape(-1, pixel_format.bits_per_pixel)
    return (bits @ (1 << np.arange(pixel_format.bits_per_pixel))).astype(np.uint16).reshape(shape)


def manual(host: RawHost) -> None:
    """Switch the automatics off, so that frames are the same each time."""
    assert [host.set(register, 0) for register in (at.EXPOSURE_AUTO, at.GAIN_AUTO)] == [0, 0]
