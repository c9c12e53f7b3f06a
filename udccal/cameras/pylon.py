"""Basler cameras through Basler's own SDK (pypylon), an optional extra."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Final, final

import numpy as np

from udccal.cameras.checks import check_mode, check_settings, not_open, superseded
from udccal.cameras.pixel_formats import PixelFormat, pixel_format
from udccal.cameras.protocol import CameraIdentity, Counts, Features, Frame, Mode, Region, Settings, Trigger
from udccal.cameras.pylon_sdk import controls
from udccal.cameras.pylon_sdk.devices import (
    OpenDevice,
    choose_info,
    close_device,
    device_infos,
    identity_of,
    load_features,
    open_device,
)
from udccal.cameras.pylon_sdk.failures import translated
from udccal.cameras.pylon_sdk.frame_ids import FrameIds
from udccal.cameras.pylon_sdk.grabbing import Grabbed, retrieve, start, stop, trigger
from udccal.cameras.pylon_sdk.loading import load_sdk
from udccal.cameras.pylon_sdk.raw_samples import send_chunks, send_raw_samples
from udccal.errors import CameraError, CameraLost

_LONGEST_TIMEOUT_S: Final = 3600.0


def list_cameras() -> tuple[CameraIdentity, ...]:
    """List the cameras that Basler's SDK sees.

    Raises:
        CameraError: when the SDK is not installed, or cannot list cameras.
    """
    return tuple(identity_of(info) for info in device_infos(load_sdk()))


@final
class PylonCamera:
    """Implements ``udccal.cameras.protocol.Camera`` on Basler's SDK.

    On opening, everything that changes raw samples is switched off (gamma, white balance, defect correction, binning,
    mirroring, automatic exposure and gain). Exposure, gain and timestamp of a frame are those of its chunk data where
    the device sends them. Otherwise they are the exposure and gain read back before the stream, and the SDK's
    timestamp; for a device without a clock it is the host's time of arrival less the exposure.
    """

    def __init__(self, serial: str | None = None, *, timeout_s: float = 2.0, feature_file: Path | None = None) -> None:
        """Find a camera without opening it.

        Args:
            serial: serial number of the camera; None for the only one.
            timeout_s: how long to wait for a frame beyond its exposure.
            feature_file: file of pylon Viewer that is loaded on opening; may choose e.g. the trigger line.

        Raises:
            CameraError: when the SDK is not installed, or the camera is not there.
        """
        if not 0 < timeout_s <= _LONGEST_TIMEOUT_S:
            raise CameraError(
                f"Expected a time-out above 0 s, at most {_LONGEST_TIMEOUT_S:g} s, found {timeout_s:g} s. Use 2 s."
            )
        self._sdk = load_sdk()
        self._identity = identity_of(choose_info(device_infos(self._sdk), serial))
        self._timeout_s, self._feature_file = timeout_s, feature_file
        self._device: OpenDevice | None = None
        self._sensor = Region(0, 0, 0, 0)
        self._counts, self._ids = Counts(), FrameIds()
        self._stream = 0

    @property
    def identity(self) -> CameraIdentity:
        """Maker, model and serial number."""
        return self._identity

    @property
    def sensor(self) -> Region:
        """The largest region that the camera offers."""
        self._opened()
        return self._sensor

    @property
    def cfa(self) -> str:
        """Pattern of the current pixel format."""
        return self._format().cfa

    @property
    def bits(self) -> int:
        """Bits of the current pixel format."""
        return self._format().bits

    @property
    def features(self) -> Features:
        """What the camera can do in the current mode."""
        device = self._opened()
        with translated(device.sdk, device.camera, "to read the camera's features"):
            return controls.read_features(device.nodes)

    @property
    def mode(self) -> Mode:
        """Current mode, read from the camera."""
        device = self._opened()
        with translated(device.sdk, device.camera, "to read the camera's mode"):
            return controls.read_mode(device.nodes)

    @property
    def counts(self) -> Counts:
        """Frames since it was opened."""
        return self._counts

    def __enter__(self) -> PylonCamera:
        """Open the camera and prepare it for raw samples.

        Raises:
            CameraLost: when it is no longer there.
            CameraBusy: when another program holds it.
            CameraError: when it refuses the feature file, or has no format of raw samples.
        """
        infos = [info for info in device_infos(self._sdk) if info.GetSerialNumber() == self._identity.serial]
        if not infos:
            raise CameraLost(
                f"Expected the camera {self._identity.serial}, found it gone. Check cable and power, then try again."
            )
        device = open_device(self._sdk, infos[0])
        try:
            self._prepare(device)
        except BaseException:
            with suppress(CameraError):
                close_device(device)
            raise
        self._device, self._counts, self._ids = device, Counts(), FrameIds()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        device, self._device = self._device, None
        self._stream += 1
        if device is not None:
            with suppress(CameraError) if error is not None else nullcontext():  # the first error is raised
                close_device(device)

    def set_mode(self, mode: Mode) -> Mode:
        """Set pixel format, frame rate and trigger; ends a stream that is running.

        Raises:
            CameraError: when the camera does not have them, or is closed.
        """
        device = self._halted()
        check_mode(mode, self.features)
        with translated(device.sdk, device.camera, f"the camera to take {mode.pixel_format} at the requested rate"):
            controls.write_mode(device.nodes, mode)
        return self.mode

    def configure(self, settings: Settings) -> Settings:
        """Set exposure, gain and region; ends a stream that is running.

        Raises:
            CameraError: when one is outside what the camera can do, or the camera is closed.
        """
        device = self._halted()
        check_settings(settings, self.features, self._sensor)
        with translated(device.sdk, device.camera, "the camera to take exposure, gain and region"):
            controls.write_settings(device.nodes, settings)
            return controls.read_settings(device.nodes)

    def frames(self, count: int) -> Iterator[Frame]:
        """Deliver ``count`` frames; one whose grab failed is incomplete and all 0.

        Raises:
            CameraTimeout: when none comes within the exposure, the frame period and the time-out.
            CameraLost: when the camera is no longer there.
            CameraError: when it is not open, or stops in another way.
        """
        device = self._halted()
        return self._deliver(device, count, self._stream) if count > 0 else iter(())

    def _deliver(self, device: OpenDevice, count: int, stream: int) -> Iterator[Frame]:
        if self._stream != stream:
            raise superseded()
        with translated(device.sdk, device.camera, "to read the camera's settings"):
            settings, software = controls.read_settings(device.nodes), self.mode.trigger is Trigger.SOFTWARE
            temperature_C = controls.read_temperature(device.nodes)
            timeout_s = self._timeout_s + max(settings.exposure_s, controls.frame_period_s(device.nodes))
            ticks_per_s = controls.ticks_per_s(device.nodes)
        self._ids.begin_stream()
        start(device, count)
        try:
            for _ in range(count):
                if self._stream != stream:
                    raise superseded()
                if software:
                    trigger(device, timeout_s)
                yield self._frame(retrieve(device, timeout_s), settings, ticks_per_s, temperature_C)
        finally:
            if self._stream == stream:  # otherwise it has ended, and another may run
                stop(device)

    def _frame(self, grabbed: Grabbed, asked: Settings, ticks_per_s: float, temperature_C: float | None) -> Frame:
        number, missed = self._ids.next(grabbed.block_id, grabbed.image_number)
        settings = replace(
            asked,
            exposure_s=asked.exposure_s if grabbed.exposure_s is None else grabbed.exposure_s,
            gain_dB=asked.gain_dB if grabbed.gain_dB is None else grabbed.gain_dB,
        )
        host_s = time.monotonic() - settings.exposure_s
        timestamp_s = grabbed.ticks / ticks_per_s if grabbed.ticks else host_s
        region, complete = settings.region, grabbed.data is not None
        data = np.zeros((region.rows, region.columns), np.uint16) if grabbed.data is None else grabbed.data
        counts = self._counts
        self._counts = Counts(counts.delivered + 1, counts.incomplete + (not complete), counts.dropped + missed)
        return Frame(data, settings, timestamp_s, number, complete, temperature_C)

    def _prepare(self, device: OpenDevice) -> None:
        if self._feature_file is not None:
            load_features(device, self._feature_file)
        with translated(device.sdk, device.camera, "to prepare the camera for raw samples"):
            send_raw_samples(device.nodes)
            send_chunks(device.nodes)
            features = controls.read_features(device.nodes)
            if not features.pixel_formats:
                raise CameraError("Expected a camera with a raw pixel format, found none. Use a Mono or Bayer camera.")
            present = device.nodes.text("PixelFormat")
            format = present if present in features.pixel_formats else features.pixel_formats[0]
            controls.write_mode(device.nodes, Mode(format))
            self._sensor = controls.read_sensor(device.nodes)

    def _format(self) -> PixelFormat:
        return pixel_format(self.mode.pixel_format)

    def _opened(self) -> OpenDevice:
        if self._device is None:
            raise not_open()
        return self._device

    def _halted(self) -> OpenDevice:
        """Return the open device with its stream ended, since settings hold for whole streams."""
        device = self._opened()
        self._stream += 1
        stop(device)
        return device
