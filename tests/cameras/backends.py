"""Every kind of camera, made ready for the tests that all of them must pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import cv2
import numpy as np
import pytest
from jaxtyping import UInt16

from tests.cameras.toy_world import flat_world
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.faults import Faults
from udccal.cameras.faults import CameraFaults
from udccal.cameras.files import FileCamera
from udccal.cameras.protocol import Camera, Mode, Region, Settings, Trigger
from udccal.cameras.pylon import PylonCamera
from udccal.cameras.pylon_sdk.loading import load_sdk
from udccal.cameras.simulated import SimulatedCamera
from udccal.cameras.u3v.camera import U3vCamera
from udccal.errors import CameraError
from udccal.io.png import write_png16

EMULATOR = "0815-0000"
FEATURE_FILE_HEADER = "# {05D8C294-F295-4dfb-9D01-096BD04049F4}\n# GenApi persistence file (version 3.1.0)\n"
NAN = float("nan")


@final
@dataclass(frozen=True)
class Backend:
    """A kind of camera.

    Attributes:
        camera: makes the camera, closed; each call the same one.
        starving: makes one that has fewer than nine frames to give, in ``starving_mode`` where that is what starves it.
        settings: that it accepts, and whose region has room for another on every side.
        accepted: what it says then.
        refused: settings that it must not accept.
        still: whether each stream begins with the same picture.
    """

    camera: Callable[[], Camera]
    starving: Callable[[], Camera]
    settings: Settings
    accepted: Settings
    refused: tuple[Settings, ...]
    still: bool
    starving_mode: Mode | None = None


def simulated(tmp_path: Path, shared_data: Callable[[], Path], monkeypatch: pytest.MonkeyPatch) -> Backend:
    world = flat_world()
    starved = SimulatedCamera(world, faults=CameraFaults(time_out_at_frame=4))
    settings = Settings(4e-3, 3.0, Region(8, 4, 64, 48))
    refused = (*_bad_settings(settings, 128, 96), replace(settings, exposure_s=100.0), replace(settings, gain_dB=25.0))
    return Backend(lambda: SimulatedCamera(world), lambda: starved, settings, settings, refused, still=False)


def png_files(tmp_path: Path, shared_data: Callable[[], Path], monkeypatch: pytest.MonkeyPatch) -> Backend:
    paths = [tmp_path / f"{index}.png" for index in range(8)]
    for path in paths:
        write_png16(path, picture(40, 48))
    return _files(lambda: FileCamera(paths, "GRBG", 12, exposure_s=0.02), 48, 40, exposure_s=0.02)


def dng_files(tmp_path: Path, shared_data: Callable[[], Path], monkeypatch: pytest.MonkeyPatch) -> Backend:
    path = shared_data() / "raw" / "colorchart.dng"
    return _files(lambda: FileCamera([path] * 8, exposure_s=0.5), 1734, 1156, exposure_s=0.5)


def pylon_emulator(tmp_path: Path, shared_data: Callable[[], Path], monkeypatch: pytest.MonkeyPatch) -> Backend:
    features = emulator_features(tmp_path, picture(96, 128), monkeypatch)
    settings = Settings(0.01, 0.0, Region(8, 4, 64, 48))
    refused = (
        *_bad_settings(settings, 4096, 4096),
        replace(settings, exposure_s=11.0),
        replace(settings, gain_dB=50.0),
    )
    return Backend(
        camera=lambda: PylonCamera(EMULATOR, feature_file=features),
        starving=lambda: PylonCamera(EMULATOR, timeout_s=0.2, feature_file=features),
        settings=settings,
        accepted=settings,
        refused=refused,
        still=True,
        starving_mode=Mode("Mono12", trigger=Trigger.EXTERNAL),
    )


def virtual_u3v(tmp_path: Path, shared_data: Callable[[], Path], monkeypatch: pytest.MonkeyPatch) -> Backend:
    bus, silent = (VirtualBackend([VirtualCamera(faults=faults)]) for faults in (Faults(), Faults(hang_at_frame=4)))
    settings = Settings(4e-3, 3.0, Region(8, 4, 64, 48))
    refused = (*_bad_settings(settings, 128, 96), replace(settings, exposure_s=11.0), replace(settings, gain_dB=25.0))
    return Backend(
        camera=lambda: U3vCamera("V0000001", backend=bus),
        starving=lambda: U3vCamera("V0000001", backend=silent),
        settings=settings,
        accepted=settings,
        refused=refused,
        still=True,
    )


BACKENDS = {
    "simulated": simulated,
    "png files": png_files,
    "dng files": dng_files,
    "pylon emulator": pylon_emulator,
    "virtual u3v": virtual_u3v,
}


def picture(rows: int, columns: int, seed: int = 0) -> UInt16[np.ndarray, "rows columns"]:
    """Twelve bits of noise: every sample identifies its place."""
    return np.random.default_rng(seed).integers(0, 4096, (rows, columns)).astype(np.uint16)


def emulator_features(
    folder: Path, mosaic: UInt16[np.ndarray, "rows columns"], monkeypatch: pytest.MonkeyPatch
) -> Path:
    """Switches on the SDK's emulated camera; returns a feature file that has it send a 12-bit mosaic."""
    try:
        load_sdk()
    except CameraError as error:
        pytest.skip(str(error))
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    (folder / "emulated").mkdir()
    # It takes files for samples of 16 bits, of which a 12-bit format has the upper ones.
    cv2.imwrite(str(folder / "emulated" / "mosaic.png"), mosaic << 4)
    features = folder / "emulator.pfs"
    features.write_text(f"{FEATURE_FILE_HEADER}ImageFilename\t{folder / 'emulated'}\nImageFileMode\tOn\n")
    return features


def _files(camera: Callable[[], Camera], columns: int, rows: int, exposure_s: float) -> Backend:
    settings = Settings(4e-3, 3.0, Region(8, 4, 32, 24))
    refused = _bad_settings(settings, columns, rows)
    return Backend(camera, camera, settings, replace(settings, exposure_s=exposure_s, gain_dB=0.0), refused, still=True)


def _bad_settings(good: Settings, columns: int, rows: int) -> tuple[Settings, ...]:
    """Settings that no camera of that sensor may accept."""
    regions = (
        Region(1, 4, 32, 24),
        Region(8, 5, 32, 24),
        Region(8, 4, 31, 24),
        Region(8, 4, 32, 23),
        Region(-8, 4, 32, 24),
        Region(8, -4, 32, 24),
        Region(8, 4, 0, 24),
        Region(8, 4, 32, 0),
        Region(8, 4, -32, 24),
        Region(columns - 24, 4, 32, 24),
        Region(8, rows - 16, 32, 24),
        Region(8, 4, 1 << 40, 24),
    )
    exposures = (NAN, 0.0, -1.0, float("inf"))
    return (
        *(replace(good, region=region) for region in regions),
        *(replace(good, exposure_s=exposure_s) for exposure_s in exposures),
        replace(good, gain_dB=NAN),
    )
