"""What only the backend of Basler's SDK does, on its emulated camera."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.cameras.backends import EMULATOR, FEATURE_FILE_HEADER, emulator_features, picture
from udccal.cameras.protocol import Counts, Mode, Region, Settings, Trigger
from udccal.cameras.pylon import PylonCamera, list_cameras
from udccal.cameras.pylon_sdk.devices import OpenDevice
from udccal.cameras.pylon_sdk.loading import load_sdk
from udccal.errors import CameraError, CameraLost, CameraTimeout

MOSAIC = picture(96, 128)
SETTINGS = Settings(5e-3, 0.0, Region(0, 0, 128, 96))


@pytest.fixture
def features(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return emulator_features(tmp_path, MOSAIC, monkeypatch)


@pytest.fixture
def camera(features: Path) -> Iterator[PylonCamera]:
    with PylonCamera(EMULATOR, timeout_s=0.5, feature_file=features) as camera:
        camera.set_mode(Mode("Mono12"))
        camera.configure(SETTINGS)
        yield camera


def opened(camera: PylonCamera) -> OpenDevice:
    """The SDK's object, on which the emulator's faults are set."""
    assert camera._device is not None
    return camera._device


@pytest.mark.parametrize("name", ["Mono12", "BayerRG12", "BayerGB12"])
def test_samples_are_exact(name: str, camera: PylonCamera) -> None:
    camera.set_mode(Mode(name))
    for frame in camera.frames(3):
        np.testing.assert_array_equal(frame.data, MOSAIC)


def test_failed_grabs_are_incomplete_frames_without_samples(camera: PylonCamera) -> None:
    nodes = opened(camera).camera.GetNodeMap()
    nodes.GetNode("ForceFailedBufferCount").SetValue(2)
    complete, data = [], []
    for index, frame in enumerate(camera.frames(6)):
        if index == 0:
            nodes.GetNode("ForceFailedBuffer").Execute()
        complete.append(frame.complete)
        data.append(frame.data)
    assert complete.count(False) == 2
    for whole, samples in zip(complete, data, strict=True):
        np.testing.assert_array_equal(samples, MOSAIC if whole else 0 * MOSAIC)
    assert camera.counts == Counts(delivered=6, incomplete=2)


def test_an_error_of_the_stream_is_told_and_the_next_stream_runs(camera: PylonCamera) -> None:
    imposed = opened(camera).camera.GetStreamGrabberNodeMap().GetNode
    stream = camera.frames(5)
    next(stream)
    imposed("ImposedError").SetValue("The bus is on fire")
    with pytest.raises(CameraError, match=r"Expected a frame, found .*The bus is on fire\. Check"):
        list(stream)
    imposed("ImposedError").SetValue("")
    assert len(list(camera.frames(2))) == 2


def test_waiting_for_an_external_trigger_is_bounded(camera: PylonCamera) -> None:
    camera.set_mode(Mode("Mono12", trigger=Trigger.EXTERNAL))
    began = time.monotonic()
    with pytest.raises(CameraTimeout, match="Expected a frame in time"):
        next(camera.frames(1))
    assert 0.5 <= time.monotonic() - began < 2.0
    camera.set_mode(Mode("Mono12"))
    assert len(list(camera.frames(2))) == 2


def test_a_slow_camera_is_waited_for(camera: PylonCamera) -> None:
    camera.set_mode(Mode("Mono12", frame_rate_hz=1.25))  # a period longer than the time-out
    assert len(list(camera.frames(2))) == 2


def test_frames_of_a_camera_without_a_clock_have_the_hosts_time(camera: PylonCamera) -> None:
    began = time.monotonic()
    times = [frame.timestamp_s for frame in camera.frames(3)]
    assert began - SETTINGS.exposure_s <= times[0] < times[1] < times[2] <= time.monotonic()


def test_opening_switches_off_what_changes_samples(features: Path) -> None:
    changed = ("TestImageSelector\tTestimage1", "Gamma\t2.0000", "DigitalShift\t2", "ReverseX\t1", "ReverseY\t1")
    automatic = ("ExposureAuto\tContinuous", "GainAuto\tContinuous", "BinningHorizontal\t2", "TriggerMode\tOn")
    features.write_text(features.read_text() + "\n".join((*changed, *automatic)) + "\n")
    with PylonCamera(EMULATOR, feature_file=features) as camera:
        nodes = opened(camera).nodes
        for name in ("TestImageSelector", "ExposureAuto", "GainAuto", "TriggerMode"):
            assert nodes.text(name) == "Off"
        assert [nodes.number(name) for name in ("Gamma", "DigitalShift", "BinningHorizontal")] == [1.0, 0.0, 1.0]
        assert nodes.flag("ReverseX") is False
        assert nodes.flag("ReverseY") is False
        camera.set_mode(Mode("Mono12"))
        camera.configure(SETTINGS)
        np.testing.assert_array_equal(next(camera.frames(1)).data, MOSAIC)


def test_refused_settings_leave_a_camera_that_works(camera: PylonCamera) -> None:
    with pytest.raises(CameraError, match="an exposure in s from 1e-06 to 10"):
        camera.configure(Settings(20.0, 0.0, SETTINGS.region))
    nodes = opened(camera).camera.GetNodeMap()
    nodes.GetNode("WidthMax").SetValue(256)  # behind the back of what was read on opening
    with pytest.raises(CameraError, match=r"Expected the camera to take exposure, gain and region, found .* refused"):
        camera.configure(Settings(5e-3, 0.0, Region(0, 0, 512, 96)))
    camera.configure(SETTINGS)
    np.testing.assert_array_equal(next(camera.frames(1)).data, MOSAIC)


def test_cameras_are_listed_and_chosen_by_serial_number(features: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    serials = [camera.serial for camera in list_cameras() if camera.model == "Emulation"]
    assert serials == [EMULATOR, "0815-0001"]
    assert PylonCamera("0815-0001").identity.serial == "0815-0001"
    with pytest.raises(CameraError, match=r"one camera to choose, found [2-9].* Give a serial number"):
        PylonCamera()
    with pytest.raises(CameraError, match=r"serial number 4711 .*found none\. Check cable and power"):
        PylonCamera("4711")


def test_a_camera_that_is_gone_when_opened_is_lost(features: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = PylonCamera(EMULATOR, feature_file=features)
    with camera:
        pass
    monkeypatch.setenv("PYLON_CAMEMU", "0")
    with pytest.raises(CameraLost, match="found it gone"):
        camera.__enter__()
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    with camera:
        camera.configure(SETTINGS)
        assert len(list(camera.frames(1))) == 1


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (None, "found none"),
        ("", "other content"),
        ("ImageFileMode\tOn\n", "other content"),
        (FEATURE_FILE_HEADER + "ImageFileMode\tPerhaps\n", "refused: Error while writing node"),
        (FEATURE_FILE_HEADER + "NoSuchFeature\t1\n", "refused: Error while writing node"),
        (FEATURE_FILE_HEADER + "x" * (2 << 20), "found none"),
    ],
)
def test_bad_feature_files_are_refused(text: str | None, found: str, features: Path, tmp_path: Path) -> None:
    path = tmp_path / "bad.pfs"
    if text is not None:
        path.write_text(text)
    with pytest.raises(CameraError, match=rf"Expected .*{found}"):
        PylonCamera(EMULATOR, feature_file=path).__enter__()
    with PylonCamera(EMULATOR, feature_file=features) as camera:  # the refusal let go of the camera
        assert camera.sensor.columns > 0


@pytest.mark.parametrize("timeout_s", [0.0, -1.0, float("nan"), float("inf")])
def test_time_outs_are_bounded(timeout_s: float) -> None:
    with pytest.raises(CameraError, match="a time-out above 0 s"):
        PylonCamera(EMULATOR, timeout_s=timeout_s)


def test_an_absent_sdk_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pypylon.pylon", None)
    for use in (load_sdk, list_cameras, PylonCamera):
        with pytest.raises(CameraError, match=r"Expected Basler's SDK .*pip install 'udccal\[pylon\]'\."):
            use()


def test_an_old_sdk_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pypylon.pylon", "pypylon.genicam"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    with pytest.raises(CameraError, match=r"pypylon 26\.6 or newer, found an older one"):
        load_sdk()


def test_the_sdk_is_loaded_when_used_and_where_warnings_are_errors(features: Path) -> None:
    program = (
        "import sys, udccal.cameras.pylon as p; assert not any(m.startswith('pypylon') for m in sys.modules);"
        "print(len(p.list_cameras()))"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert int(done.stdout) >= 1
