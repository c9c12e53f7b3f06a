"""The driver through libusb, usbfs and a host-controller driver of the kernel, to a virtual camera."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tests.usb_stack.vhci import PlugIn
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.clock import WallClock
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.memory import Status
from tests.virtual_u3v.model import CameraModel, Speed
from tests.virtual_u3v.pixel_formats import delivered
from tests.virtual_u3v.sources import PATTERN_PERIOD, Exposure, PatternSource
from udccal.cameras.protocol import Frame, Mode, Region, Settings, Trigger
from udccal.cameras.u3v.camera import U3vCamera, list_cameras
from udccal.cameras.u3v.discovery import UsbSpeed, found_devices
from udccal.errors import CameraError, CameraLost

FULL = CameraModel(columns=2048, rows=1536, frame_rate_hz=(0.1, 1000.0))
SMALL = CameraModel(columns=640, rows=480)
# No single wait of the driver is longer than this, so that whatever happens is known within a few of them.
TIMEOUT_S = 5.0


def made(model: CameraModel, faults: Faults | None = None, speed: Speed = Speed.SUPER) -> VirtualCamera:
    return VirtualCamera(model, faults=faults, speed=speed, clock=WallClock())


def settings(model: CameraModel, exposure_s: float = 1e-3) -> Settings:
    return Settings(exposure_s, 0.0, Region(0, 0, model.columns, model.rows))


def expected(frame: Frame, model: CameraModel, bits: int, block_id: int) -> np.ndarray:
    region = frame.settings.region
    place = (region.x, region.y, region.columns, region.rows)
    return delivered(PatternSource()(Exposure(block_id, 0, 1.0, 0, model.bits, *place)), model.bits, bits)


@pytest.mark.parametrize(("speed", "seen"), [(Speed.SUPER, UsbSpeed.SUPER), (Speed.HIGH, UsbSpeed.HIGH)])
def test_cameras_are_listed_with_the_speed_of_their_link(plug_in: PlugIn, speed: Speed, seen: UsbSpeed) -> None:
    assert list_cameras() == ()
    plug_in(made(SMALL, speed=speed))
    (identity,) = list_cameras()
    assert (identity.vendor, identity.model, identity.serial) == ("udccal", "Virtual-U3V", "V0000001")
    (found,) = found_devices()
    assert (found.speed, found.super_speed, found.trouble) == (seen, True, None)


def test_a_camera_without_a_configuration_is_listed_and_opened(plug_in: PlugIn) -> None:
    plug = plug_in(made(SMALL))
    plug.unconfigure()
    assert [identity.serial for identity in list_cameras()] == ["V0000001"]
    plug.unconfigure()
    with U3vCamera("V0000001", timeout_s=TIMEOUT_S) as camera:
        camera.configure(settings(SMALL))
        assert [frame.complete for frame in camera.frames(2)] == [True] * 2


def test_two_cameras_are_told_apart(plug_in: PlugIn) -> None:
    first, second = CameraModel(serial="ONE"), CameraModel(serial="TWO", columns=64)
    plug_in(made(first))
    plug_in(made(second))
    assert sorted(identity.serial for identity in list_cameras()) == ["ONE", "TWO"]
    with U3vCamera("TWO", timeout_s=TIMEOUT_S) as camera:
        assert camera.sensor.columns == 64


@pytest.mark.parametrize(("pixel_format", "bits", "count"), [("BayerRG8", 8, 25), ("BayerRG12p", 12, 10)])
def test_full_size_frames_come_bit_for_bit(
    plug_in: PlugIn, capsys: pytest.CaptureFixture[str], pixel_format: str, bits: int, count: int
) -> None:
    # The kernel's usual limit of memory for USB transfers, as on a technician's machine.
    assert Path("/sys/module/usbcore/parameters/usbfs_memory_mb").read_text().strip() == "16"
    plug_in(made(FULL))
    with U3vCamera("V0000001", timeout_s=TIMEOUT_S) as camera:
        assert camera.set_mode(Mode(pixel_format)).pixel_format == pixel_format
        accepted = camera.configure(settings(FULL, 1.003e-3))
        assert accepted.exposure_s == pytest.approx(1e-3)  # the camera rounds down to 5 us
        pictures: dict[int, np.ndarray] = {}
        for number, frame in enumerate(camera.frames(count)):
            assert (frame.frame_id, frame.complete) == (number, True)
            phase = number % PATTERN_PERIOD
            if phase not in pictures:
                pictures[phase] = expected(frame, FULL, bits, phase)
            np.testing.assert_array_equal(frame.data, pictures[phase])
        rate = frames_per_second(camera, count)
        assert (camera.counts.delivered, camera.counts.incomplete, camera.counts.dropped) == (2 * count, 0, 0)
    size_mb = FULL.columns * FULL.rows * {"BayerRG8": 1.0, "BayerRG12p": 1.5}[pixel_format] / 1e6
    with capsys.disabled():
        print(f"\ndriver, {pixel_format}: {rate:.1f} frames of {size_mb:.1f} MB per second")


def frames_per_second(camera: U3vCamera, count: int) -> float:
    """How fast frames come when nobody looks at them; the first also starts the camera, and is not counted."""
    frames = camera.frames(count)
    next(frames)
    begun = time.monotonic()
    for _ in frames:
        pass
    return (count - 1) / (time.monotonic() - begun)


def test_region_exposure_and_gain_are_read_back(plug_in: PlugIn) -> None:
    plug_in(made(SMALL))
    with U3vCamera(timeout_s=TIMEOUT_S) as camera:
        camera.set_mode(Mode("BayerRG12", frame_rate_hz=20.0))
        wish = Settings(4.003e-3, 3.0, Region(16, 8, 320, 200))
        accepted = camera.configure(wish)
        assert accepted.exposure_s == pytest.approx(4e-3)
        assert accepted.gain_dB == pytest.approx(3.0)
        assert accepted.region == wish.region
        frames = list(camera.frames(3))
    assert [f.data.shape for f in frames] == [(200, 320)] * 3
    for frame in frames:
        np.testing.assert_array_equal(frame.data, expected(frame, SMALL, 12, frame.frame_id))
        assert frame.settings.exposure_s == pytest.approx(4e-3)
    assert np.diff([f.timestamp_s for f in frames]).min() > 0.045


def test_software_triggers_give_one_frame_each(plug_in: PlugIn) -> None:
    plug_in(made(SMALL))
    with U3vCamera(timeout_s=TIMEOUT_S) as camera:
        camera.set_mode(Mode("BayerRG8", trigger=Trigger.SOFTWARE))
        camera.configure(settings(SMALL))
        times = []
        for frame in camera.frames(3):
            times.append(frame.timestamp_s)
            time.sleep(0.2)
    assert np.diff(times).min() > 0.19


def test_unplugged_in_the_middle_of_a_frame(plug_in: PlugIn) -> None:
    camera = made(SMALL, Faults(unplug_at_frame=5))
    plug_in(camera)
    got: list[Frame] = []
    with U3vCamera(timeout_s=TIMEOUT_S) as driver:
        driver.set_mode(Mode("BayerRG8"))
        driver.configure(settings(SMALL))
        begun = time.monotonic()
        with pytest.raises(CameraLost, match=r"Expected .* found .*\. \w+"):
            got.extend(driver.frames(100))
        assert time.monotonic() - begun < 2 * TIMEOUT_S
    assert [frame.frame_id for frame in got if frame.complete] == list(range(5))


def test_pulled_while_streaming_and_plugged_in_again(plug_in: PlugIn) -> None:
    camera = made(SMALL)
    plug = plug_in(camera)
    driver = U3vCamera("V0000001", timeout_s=TIMEOUT_S)
    with driver:
        driver.set_mode(Mode("BayerRG8"))
        driver.configure(settings(SMALL))
        frames = driver.frames(10_000)
        assert next(frames).complete
        plug.pull()
        begun = time.monotonic()
        with pytest.raises(CameraLost):
            for _ in frames:
                pass
        assert time.monotonic() - begun < 2 * TIMEOUT_S
        with pytest.raises(CameraLost):
            driver.configure(settings(SMALL))
    with pytest.raises(CameraLost), driver:
        pass
    plug_in(camera)
    with driver:
        driver.configure(settings(SMALL))
        assert [frame.complete for frame in driver.frames(3)] == [True] * 3


@pytest.mark.parametrize(
    "faults",
    [
        Faults(stale_acks=3),
        Faults(control_halts=1),
        Faults(lost_acks=1),
        Faults(wrong_ack_ids=1),
        Faults(garbled_acks=1),
        Faults(pending_acks=2, pending_ms=600),
        Faults(bad_statuses=1, status=Status.BUSY),
    ],
    ids=["stale", "halt", "lost", "wrong-id", "garbled", "pending", "busy"],
)
def test_trouble_on_the_control_channel_is_overcome(plug_in: PlugIn, faults: Faults) -> None:
    camera = made(SMALL)
    plug_in(camera)
    with U3vCamera(timeout_s=TIMEOUT_S) as driver:
        camera.inject(faults)
        accepted = driver.configure(settings(SMALL, 2e-3))
        assert accepted.exposure_s == pytest.approx(2e-3)
        assert [frame.complete for frame in driver.frames(2)] == [True] * 2


def test_refusal_is_told(plug_in: PlugIn) -> None:
    camera = made(SMALL)
    plug_in(camera)
    with U3vCamera(timeout_s=TIMEOUT_S) as driver:
        camera.inject(Faults(bad_statuses=1000, status=Status.ACCESS_DENIED))
        with pytest.raises(CameraError, match=r"Expected .* found .*\. \w+"):
            driver.configure(settings(SMALL, 2e-3))


@pytest.mark.parametrize(
    ("faults", "dropped"),
    [
        (Faults(stream_halts=(2,)), 0),
        (Faults(babble_frames=(2,)), 0),
        (Faults(short_frames=(2,)), 0),
        (Faults(lying_frames=(2,)), 0),
        (Faults(missing_trailers=(2,)), 0),
        (Faults(missing_leaders=(2,)), 1),
        (Faults(dropped_frames=(2,)), 1),
    ],
    ids=["halt", "babble", "short", "lying", "no-trailer", "no-leader", "dropped"],
)
def test_a_broken_frame_does_not_spoil_the_others(plug_in: PlugIn, faults: Faults, dropped: int) -> None:
    camera = made(SMALL)
    plug_in(camera)
    with U3vCamera(timeout_s=TIMEOUT_S) as driver:
        driver.set_mode(Mode("BayerRG8"))
        driver.configure(settings(SMALL))
        camera.inject(faults)
        frames = list(driver.frames(8))
        counts = driver.counts
    whole = [frame for frame in frames if frame.complete]
    assert len(frames) == counts.delivered == 8
    assert counts.incomplete == len(frames) - len(whole)
    for frame in whole:
        np.testing.assert_array_equal(frame.data, expected(frame, SMALL, 8, frame.frame_id))
    assert {frame.frame_id for frame in frames if not frame.complete} <= {2}
    assert counts.incomplete + counts.dropped == 1
    assert counts.dropped >= dropped
