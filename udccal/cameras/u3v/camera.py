"""A USB3 Vision camera behind the camera protocol."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from types import TracebackType
from typing import Any, final

from udccal.cameras.protocol import CameraIdentity, Counts, Features, Frame, Mode, Region, Settings
from udccal.cameras.u3v.acquisition import Acquisition, frame_wait_s
from udccal.cameras.u3v.bootstrap import read_bootstrap
from udccal.cameras.u3v.chunk_values import enable_chunks, tick_s
from udccal.cameras.u3v.control import ControlChannel
from udccal.cameras.u3v.delivery import Delivery
from udccal.cameras.u3v.description import read_description
from udccal.cameras.u3v.device import Device
from udccal.cameras.u3v.discovery import BACKEND, UsbCamera, find_camera, found_devices
from udccal.cameras.u3v.layout import StreamRegisters
from udccal.cameras.u3v.mode import apply_mode, choose_known_format, read_features, read_format, read_mode
from udccal.cameras.u3v.nodes import NodeMap
from udccal.cameras.u3v.pictures import PictureReader
from udccal.cameras.u3v.raw_samples import send_raw_samples
from udccal.cameras.u3v.settings import apply_settings, read_settings, read_temperature, sensor_region
from udccal.cameras.u3v.transport import UsbLink
from udccal.errors import CameraError


def list_cameras(backend: Any = None) -> tuple[CameraIdentity, ...]:
    """List the USB3 Vision cameras that are plugged in and have a readable name.

    Args:
        backend: pyusb's backend; None for libusb.

    Raises:
        CameraError: when there is no libusb.
    """
    return tuple(device.identity for device in found_devices(backend) if device.identity.serial)


@final
class U3vCamera:
    """Implements ``udccal.cameras.protocol.Camera`` on any USB3 Vision camera.

    While it is open no other program can use the camera. Frame ids continue over the calls of ``frames``, although
    cameras restart theirs with each.

    Args:
        serial: serial number; None for the only camera. Once opened, it stays the same camera.
        backend: pyusb's backend; None for libusb.
        timeout_s: limit for each answer and each part of a frame, and for a frame beyond its exposure.
    """

    def __init__(self, serial: str | None = None, *, backend: Any = None, timeout_s: float = 2.0) -> None:
        self._serial = serial
        self._backend = backend
        self._timeout_s = timeout_s
        self._identity: CameraIdentity | None = None
        self._device: Device | None = None
        self._delivery: Delivery | None = None
        self._counts = Counts()
        self._next_id = 0
        self._chunk_tick_s = 0.0

    @property
    def identity(self) -> CameraIdentity:
        """Identity of the camera, read from its descriptors before it is opened for the first time."""
        if self._identity is None:
            self._identity = find_camera(self._serial, self._backend)[0].identity
        return self._identity

    @property
    def sensor(self) -> Region:
        """The whole sensor."""
        return sensor_region(self._opened().nodes)

    @property
    def cfa(self) -> str:
        """CFA pattern of the sensor's top-left 2 x 2, and so of every region on even coordinates."""
        return read_format(self._opened().nodes).cfa

    @property
    def bits(self) -> int:
        """Bits per sample in the current mode."""
        return read_format(self._opened().nodes).bits

    @property
    def features(self) -> Features:
        """What the camera can do in the current mode."""
        return read_features(self._opened().nodes)

    @property
    def mode(self) -> Mode:
        """Current mode."""
        return read_mode(self._opened().nodes)

    @property
    def counts(self) -> Counts:
        """Frames since the camera was opened."""
        return self._counts

    def __enter__(self) -> U3vCamera:
        """Open it for this process alone.

        Raises:
            CameraLost: when it is not plugged in.
            CameraBusy: when another program holds it, or this user may not open it.
            CameraTimeout, CameraProtocolError, CameraError: when it does not behave as a USB3 Vision camera.
        """
        if self._device is not None:
            raise CameraError("Expected a closed camera, found it open already. Use it in one 'with' statement.")
        found, usb_camera = find_camera(self._serial, self._backend)
        self._device = self._open(usb_camera)
        self._counts, self._next_id, self._delivery = Counts(), 0, None
        self._serial = found.identity.serial or self._serial
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        device, self._device = self._device, None
        if device is None:
            return
        try:
            with contextlib.suppress(CameraError):  # the caller's own error counts, not one of the closing
                if self._delivery is not None:
                    self._delivery.end()
        finally:
            try:
                device.nodes.close()
            finally:
                device.link.close()

    def set_mode(self, mode: Mode) -> Mode:
        """Request a mode; return what the camera accepted, read back from it.

        Raises:
            CameraError: when it refuses.
        """
        nodes = self._idle().nodes
        nodes.refresh()
        return apply_mode(nodes, mode)

    def configure(self, settings: Settings) -> Settings:
        """Request settings; return what the camera accepted, read back from it.

        Raises:
            CameraError: when it refuses.
        """
        nodes = self._idle().nodes
        nodes.refresh()
        return apply_settings(nodes, settings)

    def frames(self, count: int) -> Iterator[Frame]:
        """Deliver ``count`` frames one at a time; incomplete ones are marked.

        The camera runs from the first requested frame until the last, or until the iterator is closed. Frames that
        come while the caller works are read into buffers, as long as there are free ones.

        Raises:
            CameraTimeout: when none comes within the exposure or the frame rate's period, plus the time-out.
            CameraLost: when the camera is no longer there.
            CameraProtocolError: when it sends something else than a frame of the current settings.
            CameraError: when it is not open, or stops in another way.
        """
        self._idle()
        self._delivery = Delivery(self._taken(count), self._count)
        return self._delivery

    def _taken(self, count: int) -> Iterator[tuple[Frame, int]]:
        if count <= 0:
            return
        device = self._opened()
        device.nodes.refresh()
        settings, mode = read_settings(device.nodes), read_mode(device.nodes)
        format, temperature_C = read_format(device.nodes), read_temperature(device.nodes)
        yield from Acquisition(
            device=device,
            reader=PictureReader(device.nodes, settings, format, self._chunk_tick_s, temperature_C),
            trigger=mode.trigger,
            wait_s=frame_wait_s(settings, mode, self._timeout_s),
            timeout_s=self._timeout_s,
        ).frames(count, self._next_id)

    def _count(self, frame: Frame, lost: int) -> None:
        self._next_id = frame.frame_id + 1
        self._counts = replace(
            self._counts,
            delivered=self._counts.delivered + 1,
            incomplete=self._counts.incomplete + (not frame.complete),
            dropped=self._counts.dropped + lost,
        )

    def _opened(self) -> Device:
        if self._device is None:
            raise CameraError("Expected an open camera, found it closed. Use it in a 'with' statement.")
        return self._device

    def _idle(self) -> Device:
        """Return the camera after ending the frames of an earlier call."""
        device = self._opened()
        if self._delivery is not None:
            self._delivery.end()
            self._delivery = None
        return device

    def _open(self, usb_camera: UsbCamera) -> Device:
        with contextlib.ExitStack() as on_failure:
            link = UsbLink(usb_camera)
            on_failure.callback(link.close)
            control = ControlChannel(link, self._timeout_s)
            bootstrap = read_bootstrap(control)
            nodes = NodeMap(read_description(control, bootstrap.manifest_address), control)
            on_failure.callback(nodes.close)
            device = Device(link, control, StreamRegisters(control, bootstrap.sirm_address), nodes)
            device.leave_any_run()
            send_raw_samples(nodes)
            choose_known_format(nodes)
            enable_chunks(nodes)
            self._chunk_tick_s = tick_s(nodes)
            self._identity = CameraIdentity(bootstrap.vendor, bootstrap.model, bootstrap.serial, BACKEND)
            on_failure.pop_all()
        return device
