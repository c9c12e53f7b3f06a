"""Questions for a child process, since they load software that may hang or crash."""

from __future__ import annotations

import enum
from collections.abc import Sequence

from udccal.cameras.protocol import CameraIdentity
from udccal.doctor.answers import JaxDevice, SeenCamera


class Question(enum.StrEnum):
    """One question."""

    U3V = "u3v"
    PYLON = "pylon"
    JAX = "jax"


def answer(question: Question) -> Sequence[SeenCamera] | Sequence[JaxDevice]:
    """Load the software that the question is about, and look.

    Raises:
        CameraError: when a camera backend cannot look.
    """
    match question:
        case Question.U3V:
            return _u3v_cameras()
        case Question.PYLON:
            return _pylon_cameras()
        case Question.JAX:
            return _jax_devices()


def _u3v_cameras() -> list[SeenCamera]:
    from udccal.cameras.u3v.discovery import UsbSpeed, found_devices

    return [
        SeenCamera(
            name=_name(device.identity),
            too_slow=device.super_speed and UsbSpeed.UNKNOWN < device.speed < UsbSpeed.SUPER,
            trouble=device.trouble or "",
        )
        for device in found_devices()
    ]


def _pylon_cameras() -> list[SeenCamera]:
    from udccal.cameras.pylon import list_cameras

    return [SeenCamera(_name(identity)) for identity in list_cameras()]


def _jax_devices() -> list[JaxDevice]:
    import jax

    return [JaxDevice(device.platform, device.device_kind) for device in jax.devices()]


def _name(identity: CameraIdentity) -> str:
    words = (identity.vendor, identity.model, identity.serial)
    return " ".join(word[:100] for word in words if word) or "a camera without a name"
