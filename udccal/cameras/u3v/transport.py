"""The USB side of one open camera: its three endpoints; every transfer has a time limit."""

from __future__ import annotations

import contextlib
from array import array
from collections.abc import Iterator
from typing import Any, final

import usb.control
import usb.core
import usb.util

from udccal.cameras.u3v.discovery import UsbCamera, UsbInterfaces, configure
from udccal.cameras.u3v.usb_errors import TransferFailed, usb_errors
from udccal.errors import CameraError, CameraLost


@final
class UsbLink:
    """A camera's interfaces, claimed for this process alone until ``close``.

    Raises:
        CameraBusy: on opening, when another program holds the camera or this user may not open it.
        CameraLost: on opening, when it is gone.
    """

    def __init__(self, camera: UsbCamera) -> None:
        self._device: Any = camera.device
        self._interfaces: UsbInterfaces = camera.interfaces
        try:
            with self._errors("opening the camera"):
                configure(self._device, self._interfaces.configuration)
                for number in self._interfaces.numbers:
                    self._claim(number)
                self._stream_in = self._endpoint(self._interfaces.stream_in)
                self._control_in = self._endpoint(self._interfaces.control_in)
        except BaseException:
            self.close()
            raise

    @property
    def control_packet(self) -> int:
        """Bytes of a full packet from the control endpoint; the length of a read is a multiple of it."""
        return int(self._control_in.wMaxPacketSize)

    @property
    def stream_packet(self) -> int:
        """Bytes of a full packet from the stream endpoint."""
        return int(self._stream_in.wMaxPacketSize)

    def send(self, command: bytes, timeout_s: float) -> None:
        """Send a message to the control endpoint.

        Raises:
            CameraTimeout, CameraLost, CameraError: when USB fails; of the last kind, those that are RECOVERABLE.
        """
        with self._errors("sending a command"):
            sent = self._device.write(self._interfaces.control_out, command, _ms(timeout_s))
        if sent != len(command):
            raise CameraError(f"Expected {len(command)} bytes of a command to go out, found {sent}. Check the cable.")

    def receive(self, length: int, timeout_s: float) -> bytes:
        """Return one message from the control endpoint, of ``length`` bytes at most.

        Raises:
            CameraTimeout, CameraLost, CameraError: when USB fails; of the last kind, those that are RECOVERABLE.
        """
        with self._errors("waiting for an acknowledge"):
            data = self._device.read(self._interfaces.control_in, length, _ms(timeout_s))
        return bytes(data)

    def read_stream(self, buffer: array[int], timeout_s: float) -> int:
        """Fill a buffer of bytes from the stream; a short packet ends the transfer early.

        Returns:
            How many bytes came; fewer also when the time ran out after some, which is no error in USB.

        Raises:
            CameraTimeout, CameraLost, CameraError: when USB fails; of the last kind, those that are RECOVERABLE.
        """
        with self._errors("reading the stream"):
            return int(self._device.read(self._interfaces.stream_in, buffer, _ms(timeout_s)))

    def clear_control_halts(self) -> None:
        """Make the control endpoints usable again."""
        with self._errors("clearing the control endpoints"):
            self._device.clear_halt(self._interfaces.control_in)
            self._device.clear_halt(self._interfaces.control_out)

    def clear_stream_halt(self) -> None:
        """Make the stream endpoint usable again."""
        with self._errors("clearing the stream endpoint"):
            self._device.clear_halt(self._interfaces.stream_in)

    def flush_stream(self) -> None:
        """Halt the stream endpoint and clear it again; a device then discards what it has not sent."""
        with self._errors("resetting the stream endpoint"):
            # A device that the host cannot halt answers this request with a stall.
            with contextlib.suppress(usb.core.USBError):
                usb.control.set_feature(self._device, usb.control.ENDPOINT_HALT, self._stream_in)
            self._device.clear_halt(self._interfaces.stream_in)

    def close(self) -> None:
        """Release the interfaces and the device, whatever state they are in."""
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            usb.util.dispose_resources(self._device)

    @contextlib.contextmanager
    def _errors(self, doing: str) -> Iterator[None]:
        try:
            with usb_errors(doing):
                yield
        except TransferFailed as error:
            # A cable that is pulled during a transfer causes an error like any other, and for a moment the system
            # still lists the camera. So the camera itself is asked.
            if self._answers():
                raise
            raise CameraLost(
                f"Expected the camera while {doing}, found it gone. Plug it in and open it again."
            ) from error

    def _answers(self) -> bool:
        try:
            usb.control.get_status(self._device)
        except usb.core.USBError:
            return False
        return True

    def _claim(self, number: int) -> None:
        with contextlib.suppress(NotImplementedError):  # only Linux has drivers to detach
            if self._device.is_kernel_driver_active(number):
                self._device.detach_kernel_driver(number)
        usb.util.claim_interface(self._device, number)

    def _endpoint(self, address: int) -> Any:
        for interface in self._device.get_active_configuration():
            for endpoint in interface:
                if endpoint.bEndpointAddress == address:
                    return endpoint
        raise CameraError(f"Expected endpoint {address:#04x} of the camera, found none. Plug it in again.")


def _ms(timeout_s: float) -> int:
    """Convert to pyusb's unit; its 0 would mean to wait without end."""
    return max(1, round(1e3 * timeout_s))
