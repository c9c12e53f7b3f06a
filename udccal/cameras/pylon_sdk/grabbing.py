"""Grabs frames: copies the SDK's results with their chunk values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
from jaxtyping import UInt16

from udccal.cameras.pixel_formats import pixel_format_of, unpack
from udccal.cameras.pylon_sdk.devices import OpenDevice
from udccal.cameras.pylon_sdk.failures import removed_within, translated
from udccal.cameras.pylon_sdk.nodes import Nodes
from udccal.errors import CameraError, CameraLost

_BUFFERS: Final = 16
_REMOVAL_S: Final = 0.5
_US_PER_S: Final = 1e6


@final
@dataclass(frozen=True)
class Grabbed:
    """One result. ``data`` is None when the grab failed; chunk values are None where the device sends none.

    Attributes:
        ticks: camera's clock at the start of the exposure; 0 when it has no clock.
    """

    data: UInt16[np.ndarray, "rows columns"] | None
    block_id: int
    image_number: int
    ticks: int
    exposure_s: float | None
    gain_dB: float | None


def start(device: OpenDevice, count: int) -> None:
    """Begin an acquisition of ``count`` frames on an open ``device``; up to 16 may wait to be retrieved.

    Raises:
        CameraLost, CameraError: when the camera does not start.
    """
    strategy, loop = device.sdk.pylon.GrabStrategy_OneByOne, device.sdk.pylon.GrabLoop_ProvidedByUser
    with translated(device.sdk, device.camera, "the camera to start", _REMOVAL_S):
        device.camera.MaxNumBuffer.SetValue(_BUFFERS)
        device.camera.StartGrabbingMax(count, strategy, loop)


def stop(device: OpenDevice) -> None:
    """End the acquisition of ``device``, if there is one.

    Raises:
        CameraLost, CameraError: when the camera does not answer.
    """
    with translated(device.sdk, device.camera, "the camera to stop", _REMOVAL_S):
        device.camera.StopGrabbing()


def trigger(device: OpenDevice, timeout_s: float) -> None:
    """Wait at most ``timeout_s`` until ``device`` can expose, then trigger it.

    Raises:
        CameraTimeout: when it is not ready in time.
        CameraLost, CameraError: when it does not answer.
    """
    throw = device.sdk.pylon.TimeoutHandling_ThrowException
    with translated(device.sdk, device.camera, "the camera to be ready for a trigger", _REMOVAL_S):
        if device.camera.CanWaitForFrameTriggerReady():
            device.camera.WaitForFrameTriggerReady(_ms(timeout_s), throw)
        device.camera.ExecuteSoftwareTrigger()


def retrieve(device: OpenDevice, timeout_s: float) -> Grabbed:
    """Return the next result of ``device`` with a copy of its samples; wait at most ``timeout_s``.

    Raises:
        CameraTimeout: when none comes in time.
        CameraLost: when the camera is gone.
        CameraError: when the acquisition ended in another way.
    """
    throw = device.sdk.pylon.TimeoutHandling_ThrowException
    with translated(device.sdk, device.camera, "a frame", _REMOVAL_S):
        result = device.camera.RetrieveResult(_ms(timeout_s), throw)
        if result.IsValid():
            try:
                return _copied(result)
            finally:
                result.Release()
    if removed_within(device.camera, _REMOVAL_S):
        raise CameraLost("Expected a frame, found the camera gone. Check cable and power, then open it again.")
    raise CameraError("Expected a frame, found that the camera had stopped. Ask for frames again.")


def _copied(result: Any) -> Grabbed:
    chunks = Nodes(result.GetChunkDataNodeMap()) if result.IsChunkDataAvailable() else None
    exposure_us = chunks.number("ChunkExposureTime") if chunks else None
    ticks = chunks.number("ChunkTimestamp") if chunks else None
    return Grabbed(
        data=_samples(result) if result.GrabSucceeded() else None,
        block_id=int(result.GetBlockID()),
        image_number=int(result.GetImageNumber()),
        ticks=int(result.GetTimeStamp()) if ticks is None else int(ticks),
        exposure_s=None if exposure_us is None else exposure_us / _US_PER_S,
        gain_dB=chunks.number("ChunkGain") if chunks else None,
    )


def _samples(result: Any) -> UInt16[np.ndarray, "rows columns"]:
    format = pixel_format_of(int(result.GetPixelType()))
    memory = result.GetImageMemoryView()
    try:
        return unpack(memory, format, int(result.GetHeight()), int(result.GetWidth()), int(result.GetPaddingX()))
    finally:
        memory.release()


def _ms(seconds: float) -> int:
    return max(1, round(1e3 * seconds))
