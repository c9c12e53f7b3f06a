"""The mode in which a camera serves a rig."""

from __future__ import annotations

from udccal.cameras.pixel_formats import PIXEL_FORMATS
from udccal.cameras.protocol import Features, Mode
from udccal.errors import CameraError


def mode_for(features: Features, cfa: str, bits: int) -> Mode:
    """A free-running mode with the pattern and the bits that a rig's description asks for; packed ones need less USB.

    Raises:
        CameraError: when the camera has no such format.
    """
    known = [PIXEL_FORMATS[name] for name in features.pixel_formats if name in PIXEL_FORMATS]
    fitting = [each for each in known if (each.cfa, each.bits) == (cfa, bits)]
    if not fitting:
        raise CameraError(
            f"Expected a camera with a pixel format of {bits} bits and the pattern {cfa}, as the rig says, found "
            f"{', '.join(features.pixel_formats) or 'none'}. Connect the right camera, or correct rig.toml."
        )
    return Mode(min(fitting, key=lambda each: each.bits_per_pixel).name)
