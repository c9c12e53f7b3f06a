from __future__ import annotations

import errno

import pytest
from usb.core import USBError, USBTimeoutError

from udccal.cameras.u3v.usb_errors import EndpointHalted, TransferFailed, TransferOverflow, usb_errors
from udccal.errors import CameraBusy, CameraError, CameraLost, CameraTimeout

# What each of libusb's codes means to a camera.
MEANINGS = [
    (-1, errno.EIO, TransferFailed),
    (-3, errno.EACCES, CameraBusy),
    (-4, errno.ENODEV, CameraLost),
    (-5, errno.ENOENT, CameraLost),
    (-6, errno.EBUSY, CameraBusy),
    (-7, errno.ETIMEDOUT, CameraTimeout),
    (-8, errno.EOVERFLOW, TransferOverflow),
    (-9, errno.EPIPE, EndpointHalted),
    (-10, errno.EINTR, CameraTimeout),
    (-11, errno.ENOMEM, CameraError),
    (-99, None, CameraError),
]


@pytest.mark.parametrize(("code", "number", "expected"), MEANINGS)
def test_errors_are_told_by_errno_or_by_libusbs_code(code: int, number: int | None, expected: type) -> None:
    for error in (USBError("libusb's text", code, number), USBError("libusb's text", code, None)):
        with (
            pytest.raises(CameraError, match=r"Expected .* while reading.* found.*\. \w+") as caught,
            usb_errors("reading"),
        ):
            raise error
        assert type(caught.value) is expected


@pytest.mark.parametrize("number", [errno.ESHUTDOWN, errno.ENXIO])
def test_other_words_for_a_pulled_cable(number: int) -> None:
    with pytest.raises(CameraLost), usb_errors("reading"):
        raise USBError("text", None, number)


def test_pyusbs_own_time_out_needs_no_number() -> None:
    with pytest.raises(CameraTimeout), usb_errors("reading"):
        raise USBTimeoutError("text")


def test_systems_without_access_say_what_to_do() -> None:
    with pytest.raises(CameraError, match="WinUSB"), usb_errors("reading"):
        raise NotImplementedError("Operation not supported")


def test_other_errors_pass() -> None:
    with pytest.raises(ZeroDivisionError), usb_errors("reading"):
        raise ZeroDivisionError
