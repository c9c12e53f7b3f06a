"""Questions for a child process, since they load software that may hang or crash."""

from __future__ import annotations

import enum
from collections.abc import Sequence

from udccal.cameras.protocol import Camera, CameraIdentity
from udccal.doctor.answers import JaxDevice, OpenedCamera, SeenCamera
from udccal.errors import CameraError


class Question(enum.StrEnum):
    """One question."""

    U3V = "u3v"
    PYLON = "pylon"
    JAX = "jax"
    OPEN_U3V = "open-u3v"
    OPEN_PYLON = "open-pylon"


def answer(
    question: Question, words: Sequence[str] = ()
) -> Sequence[SeenCamera] | Sequence[JaxDevice] | Sequence[OpenedCamera]:
    """Load the software that the question is about, and look.

    Args:
        question: what to look for.
        words: for opening a camera: its serial number (empty for the only one), and the rig's pattern and bits.

    Raises:
        CameraError: when a camera backend cannot look, or cannot open the camera.
    """
    match question:
        case Question.U3V:
            return _u3v_cameras()
        case Question.PYLON:
            return _pylon_cameras()
        case Question.JAX:
            return _jax_devices()
        case Question.OPEN_U3V:
            from udccal.cameras.u3v.camera import U3vCamera

            return _opened(U3vCamera(words[0] or None), words[1], int(words[2]))
        case Question.OPEN_PYLON:
            from udccal.cameras.pylon import PylonCamera

            return _opened(PylonCamera(words[0] or None), words[1], int(words[2]))


def _u3v_cameras() -> list[SeenCamera]:
    from udccal.cameras.u3v.discovery import UsbSpeed, found_devices

    return [
        SeenCamera(
            name=_name(device.identity),
            too_slow=device.super_speed and UsbSpeed.UNKNOWN < device.speed < UsbSpeed.SUPER,
            trouble=device.trouble or "",
            serial=device.identity.serial,
        )
        for device in found_devices()
    ]


def _pylon_cameras() -> list[SeenCamera]:
    from udccal.cameras.pylon import list_cameras

    return [SeenCamera(_name(identity), serial=identity.serial) for identity in list_cameras()]


def _opened(camera: Camera, cfa: str, bits: int) -> list[OpenedCamera]:
    from udccal.cameras.choice import mode_for

    refusal = ""
    with camera:
        try:
            camera.set_mode(mode_for(camera.features, camera.sensor, cfa, bits))
        except CameraError as error:
            refusal = str(error)
        sensor, features = camera.sensor, camera.features
    exposures = features.exposure_s
    return [
        OpenedCamera(sensor.columns, sensor.rows, features.frame_rate_hz.high, exposures.low, exposures.high, refusal)
    ]


def _jax_devices() -> list[JaxDevice]:
    import jax

    return [JaxDevice(device.platform, device.device_kind) for device in jax.devices()]


def _name(identity: CameraIdentity) -> str:
    words = (identity.vendor, identity.model, identity.serial)
    return " ".join(word[:100] for word in words if word) or "a camera without a name"
