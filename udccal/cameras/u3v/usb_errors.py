"""Turns pyusb's exceptions into the errors of cameras."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, final

import usb.core

from udccal.errors import CameraBusy, CameraError, CameraLost, CameraTimeout


@final
class EndpointHalted(CameraError):
    """An endpoint is halted and must be cleared before it is used again."""


@final
class TransferOverflow(CameraError):
    """A device sent more than was requested; the received data are useless."""


@final
class TransferFailed(CameraError):
    """The bus failed during a transfer, as with a bad cable; the next transfer may succeed."""


# After any of these the endpoint is cleared and the transfer may be tried again.
RECOVERABLE: Final = (EndpointHalted, TransferOverflow, TransferFailed)

# libusb's own codes, for platforms where pyusb finds no errno for them (libusb.h, enum libusb_error).
_ERRNO_OF_LIBUSB: Final = {
    -1: errno.EIO,
    -3: errno.EACCES,
    -4: errno.ENODEV,
    -5: errno.ENOENT,
    -6: errno.EBUSY,
    -7: errno.ETIMEDOUT,
    -8: errno.EOVERFLOW,
    -9: errno.EPIPE,
    -10: errno.EINTR,
    -11: errno.ENOMEM,
}

_LOST: Final = frozenset({errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN, errno.ENOENT})
_DENIED: Final = frozenset({errno.EACCES, errno.EPERM})
# A system call that a signal interrupted has sent nothing: for the caller, the wait ended without an answer.
_TIMED_OUT: Final = frozenset({errno.ETIMEDOUT, errno.EINTR})


def camera_error(error: usb.core.USBError, doing: str) -> CameraError:
    """Return the camera's error for one of pyusb's, whose content differs from backend to backend."""
    number = error.errno if error.errno is not None else _ERRNO_OF_LIBUSB.get(error.backend_error_code)
    if isinstance(error, usb.core.USBTimeoutError) or number in _TIMED_OUT:
        return CameraTimeout(f"Expected the camera to answer in time while {doing}, found silence. Check the cable.")
    if number in _LOST:
        return CameraLost(f"Expected the camera while {doing}, found it gone. Plug it in and open it again.")
    if number == errno.EPIPE:
        return EndpointHalted(f"Expected data while {doing}, found the endpoint halted. Open the camera again.")
    if number == errno.EOVERFLOW:
        return TransferOverflow(f"Expected no more data than requested while {doing}, found more. Try again.")
    if number == errno.EBUSY:
        return CameraBusy(
            f"Expected the camera to be free while {doing}, found it held by another program. Close that program."
        )
    if number in _DENIED:
        return CameraBusy(
            f"Expected permission to use the camera while {doing}, found none. On Linux install a udev rule for it "
            "('udccal doctor' prints one) and plug it in again."
        )
    if number == errno.EIO:
        return TransferFailed(
            f"Expected an intact transfer while {doing}, found an error. Check the cable, port and hub."
        )
    if number == errno.ENOMEM:
        return CameraError(
            f"Expected memory for a USB transfer while {doing}, found none left. Raise usbfs_memory_mb "
            "(/sys/module/usbcore/parameters), or close other cameras."
        )
    return CameraError(f"Expected USB to work while {doing}, found: {error}. Check the cable, port and hub.")


@contextmanager
def usb_errors(doing: str) -> Iterator[None]:
    """Turn pyusb's exceptions in the context into the errors of cameras; ``doing`` is part of their sentence."""
    try:
        yield
    except usb.core.USBError as error:
        raise camera_error(error, doing) from error
    except NotImplementedError as error:
        raise CameraError(
            f"Expected USB access while {doing}, found that the system's driver does not give it. On Windows bind "
            "the camera to WinUSB (for example with Zadig)."
        ) from error
