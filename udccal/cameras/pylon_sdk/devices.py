"""Lists the cameras that the SDK sees, and opens one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

from udccal.cameras.protocol import CameraIdentity
from udccal.cameras.pylon_sdk.failures import reason_of, translated
from udccal.cameras.pylon_sdk.loading import Sdk
from udccal.cameras.pylon_sdk.nodes import Nodes
from udccal.errors import CameraBusy, CameraError, CameraLost

# First line of the files that pylon Viewer writes.
_FEATURE_FILE: Final = "# {05D8C294-F295-4dfb-9D01-096BD04049F4}"
_MAX_FEATURE_BYTES: Final = 1 << 20
_MAX_NAME: Final = 100


@final
@dataclass(frozen=True)
class OpenDevice:
    """An open camera: the SDK's object for it, and its features."""

    sdk: Sdk
    camera: Any
    nodes: Nodes


def device_infos(sdk: Sdk) -> Sequence[Any]:
    """Return the cameras that the transport layers of ``sdk`` find, as its ``DeviceInfo`` objects.

    Raises:
        CameraError: when they cannot search.
    """
    try:
        return tuple(sdk.pylon.TlFactory.GetInstance().EnumerateDevices())
    except sdk.genicam.GenericException as error:
        raise CameraError(
            f"Expected Basler's SDK to list its cameras, found: {reason_of(error)}. Check its installation."
        ) from error


def identity_of(info: Any) -> CameraIdentity:
    """Return vendor, model and serial number of the SDK's device ``info``."""
    texts = (info.GetVendorName(), info.GetModelName(), info.GetSerialNumber())
    vendor, model, serial = (str(text)[:_MAX_NAME] or "not stated" for text in texts)
    return CameraIdentity(vendor, model, serial, "pylon")


def choose_info(infos: Sequence[Any], serial: str | None) -> Any:
    """Return the camera with that ``serial`` number among ``infos``, or for None the only one.

    Raises:
        CameraError: when there is none, or there are several and ``serial`` is None.
    """
    if serial is not None:
        infos = [info for info in infos if info.GetSerialNumber() == serial]
    if len(infos) == 1:
        return infos[0]
    wanted = "a camera" if serial is None else f"the camera with serial number {serial[:_MAX_NAME]}"
    if not infos:
        raise CameraLost(
            f"Expected {wanted} for Basler's SDK, found none. Check cable and power; 'udccal doctor' says more."
        )
    serials = ", ".join(str(info.GetSerialNumber()) for info in infos)
    raise CameraError(f"Expected one camera to choose, found {len(infos)} ({serials}). Give a serial number.")


def open_device(sdk: Sdk, info: Any) -> OpenDevice:
    """Open the camera ``info`` through ``sdk`` for control and streaming.

    Raises:
        CameraBusy: when another program holds it, or this user may not open it.
        CameraLost: when it cannot be reached.
    """
    factory = sdk.pylon.TlFactory.GetInstance()
    name = identity_of(info).serial
    held = (sdk.pylon.Accessibility_Opened, sdk.pylon.Accessibility_OpenedExclusively)
    try:
        accessible, why = factory.IsDeviceAccessibleInfo(info)
        if not accessible and why in held:
            raise CameraBusy(
                f"Expected to open the camera {name}, found it held by another program. Close other programs that use "
                "it, such as pylon Viewer."
            )
        if not accessible:
            raise CameraLost(
                f"Expected to open the camera {name}, found that it cannot be reached. Plug it in again; "
                "'udccal doctor' says which permissions it needs."
            )
        camera = sdk.pylon.InstantCamera(factory.CreateDevice(info))
        camera.Open()
    except sdk.genicam.GenericException as error:
        raise CameraBusy(
            f"Expected to open the camera {name}, found: {reason_of(error)}. Close other programs that use it, such as "
            "pylon Viewer; 'udccal doctor' says which permissions it needs."
        ) from error
    return OpenDevice(sdk, camera, Nodes(camera.GetNodeMap()))


def load_features(device: OpenDevice, path: Path) -> None:
    """Load the feature file of pylon Viewer at ``path`` into an open ``device``.

    Raises:
        CameraError: when it is not one, or the camera refuses a line of it.
    """
    if not path.is_file() or os.path.getsize(path) > _MAX_FEATURE_BYTES:
        raise CameraError(f"Expected a feature file of pylon Viewer at {path}, found none. Check the path.")
    text = path.read_text("utf-8", "replace")
    if not text.startswith(_FEATURE_FILE):
        raise CameraError(
            f"Expected {path} to be a feature file (.pfs) of pylon Viewer, found other content. Save it there again."
        )
    with translated(device.sdk, device.camera, f"to set the features in {path}"):
        device.sdk.pylon.FeaturePersistence.LoadFromString(text, device.camera.GetNodeMap(), True)


def close_device(device: OpenDevice) -> None:
    """Close the camera ``device``; one that is gone already is released without an error.

    Raises:
        CameraError: when it does not close.
    """
    with suppress(CameraLost), translated(device.sdk, device.camera, "the camera to close"):
        device.camera.Close()
        device.camera.DestroyDevice()
