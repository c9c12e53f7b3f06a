"""Chooses the camera's mode for a rig, and checks that it is the rig's camera."""

from __future__ import annotations

from udccal.cameras.pixel_formats import PIXEL_FORMATS, payload_bytes
from udccal.cameras.protocol import Camera, Features, Mode, Region
from udccal.errors import CameraError
from udccal.rig import RigDescription

# Half of the rate of USB 3: a driver that reads one transfer after the other, on a computer that does other things,
# keeps up with it. Faster cameras are limited to it; a calibration waits for light and hands, not for frames.
MOST_BYTES_PER_S = 200e6


def mode_for(
    features: Features, sensor: Region, cfa: str, bits: int, most_bytes_per_s: float = MOST_BYTES_PER_S
) -> Mode:
    """Return a free-running mode with the pattern and the bits of a rig's description, packed if the camera can.

    Args:
        features: what the camera can do.
        sensor: whole sensor of the camera.
        cfa: pattern in the rig's description.
        bits: bits per sample in the rig's description.
        most_bytes_per_s: highest rate of whole frames that the link carries without loss.

    Raises:
        CameraError: when the camera has no such format.
    """
    known = [PIXEL_FORMATS[name] for name in features.pixel_formats if name in PIXEL_FORMATS]
    fitting = [each for each in known if (each.cfa, each.bits) == (cfa, bits)]
    if not fitting:
        raise CameraError(
            f"Expected a camera with a pixel format of {bits} bits and the pattern {cfa} of the rig, found "
            f"{', '.join(features.pixel_formats) or 'none'}. Connect the right camera, or correct rig.toml."
        )
    chosen = min(fitting, key=lambda each: each.bits_per_pixel)
    rate_hz = most_bytes_per_s / payload_bytes(chosen, sensor.rows, sensor.columns)
    rates = features.frame_rate_hz
    return Mode(chosen.name, None if rate_hz >= rates.high else max(rate_hz, rates.low))


def check_camera(camera: Camera, rig: RigDescription) -> None:
    """Check that an open camera is that of a rig's description.

    Raises:
        CameraError: when its size, pattern or bits differ.
    """
    expected = (rig.camera.columns, rig.camera.rows, rig.camera.cfa, rig.camera.bits)
    found = (camera.sensor.columns, camera.sensor.rows, camera.cfa, camera.bits)
    if found != expected:
        raise CameraError(
            f"Expected a camera of {expected[0]} x {expected[1]}, {expected[2]}, {expected[3]} bits as in the rig "
            f"'{rig.name}', found {found[0]} x {found[1]}, {found[2]}, {found[3]} bits. "
            "Connect the right camera, or correct rig.toml."
        )
