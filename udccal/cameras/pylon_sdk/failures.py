"""Turns the SDK's exceptions into this project's errors."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from udccal.cameras.pylon_sdk.loading import Sdk
from udccal.errors import CameraError, CameraLost, CameraTimeout

_MAX_REASON: Final = 200
_POLL_S: Final = 0.05


@contextmanager
def translated(sdk: Sdk, device: Any, expected: str, patience_s: float = 0.0) -> Iterator[None]:
    """Turn an exception of the SDK into a typed error.

    Args:
        sdk: the SDK.
        device: the ``InstantCamera`` in use.
        expected: what was expected, as the middle of a sentence.
        patience_s: how long to wait for the SDK to notice that the device is gone; it does so some time after the
            first error.

    Raises:
        CameraTimeout: in place of ``TimeoutException``.
        CameraLost: when the device is no longer there.
        CameraError: in place of any other.
    """
    try:
        yield
    except sdk.genicam.TimeoutException as error:
        raise CameraTimeout(
            f"Expected {expected} in time, found none. Check the trigger, the exposure and the cable."
        ) from error
    except sdk.genicam.GenericException as error:
        if removed_within(device, patience_s):
            raise CameraLost(
                f"Expected {expected}, found the camera gone. Check cable and power, then open it again."
            ) from error
        raise CameraError(
            f"Expected {expected}, found that the camera refused: {reason_of(error)}. Check the setting and the camera."
        ) from error


def reason_of(error: Exception) -> str:
    """Return the SDK's message without the place in its source."""
    return " ".join(str(error).split(" : ")[0].split()).rstrip(".")[:_MAX_REASON] or type(error).__name__


def removed_within(device: Any, patience_s: float) -> bool:
    """Return whether the SDK notices within that time that the device was removed."""
    deadline = time.monotonic() + patience_s
    while not device.IsCameraDeviceRemoved():
        if time.monotonic() >= deadline:
            return False
        time.sleep(_POLL_S)
    return True
