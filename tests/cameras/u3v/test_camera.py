"""The driver on a virtual camera that behaves."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from tests.cameras.u3v.small_frames import REGION, SETTINGS, pattern
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.model import CameraModel, Speed
from tests.virtual_u3v.pixel_formats import delivered
from udccal.cameras.pixel_formats import pixel_format
from udccal.cameras.protocol import Camera, CameraIdentity, Counts, Frame, Mode, Range, Region, Settings, Trigger
from udccal.cameras.u3v.camera import U3vCamera
from udccal.errors import CameraError, CameraTimeout

SENTENCE = r"Expected .* found .*\. \w+"


@pytest.fixture
def camera(device: VirtualCamera) -> Iterator[U3vCamera]:
    with U3vCamera(backend=VirtualBackend([device])) as opened:
        yield opened


def sent(device: VirtualCamera, frame: Frame, block_id: int, name: str) -> np.ndarray:
    """The pattern as the camera sends it in a format."""
    return delivered(pattern(frame, block_id, device.model.bits), device.model.bits, pixel_format(name).bits)


def test_is_a_camera_that_says_what_it_is(camera: U3vCamera) -> None:
    assert isinstance(camera, Camera)
    assert camera.identity == CameraIdentity("udccal", "Virtual-U3V", "V0000001", "u3v")
    assert (camera.sensor, camera.cfa) == (Region(0, 0, 128, 96), "RGGB")
    features = camera.features
    assert (features.exposure_s.low, features.exposure_s.high) == (pytest.approx(20e-6), pytest.approx(10.0))
    assert (features.gain_dB, features.frame_rate_hz) == (Range(0.0, 24.0), Range(0.1, 120.0))
    assert features.pixel_formats[0] == "BayerRG8"
    assert "BayerRG12p" in features.pixel_formats
    assert features.triggers == (Trigger.FREE_RUN, Trigger.SOFTWARE, Trigger.EXTERNAL)
    assert features.region_steps == (4, 2, 8, 2)


def test_identity_is_known_before_it_is_opened(device: VirtualCamera) -> None:
    assert U3vCamera(backend=VirtualBackend([device])).identity.serial == "V0000001"


def test_automatics_are_off(camera: U3vCamera, device: VirtualCamera) -> None:
    assert [device._memory.uint(register) for register in (at.EXPOSURE_AUTO, at.GAIN_AUTO)] == [0, 0]


def test_settings_are_those_that_the_device_accepted(camera: U3vCamera) -> None:
    accepted = camera.configure(Settings(1.2343e-3, 2.96, REGION))
    assert (accepted.exposure_s, accepted.gain_dB) == (pytest.approx(1.23e-3), pytest.approx(3.0))
    assert accepted.region == REGION
    (frame,) = camera.frames(1)
    assert frame.settings == accepted
    # Each region can follow each other, whatever bounds their offsets and sizes put on each other.
    for region in (Region(0, 0, 128, 96), Region(120, 94, 8, 2), Region(0, 0, 8, 2), Region(4, 2, 120, 94), REGION):
        assert camera.configure(Settings(4e-3, 0.0, region)).region == region


@pytest.mark.parametrize("high", [True, False])
def test_accepts_both_ends_of_what_it_can_do(camera: U3vCamera, high: bool) -> None:
    features = camera.features
    exposure_s, gain_dB = (r.high if high else r.low for r in (features.exposure_s, features.gain_dB))
    accepted = camera.configure(Settings(exposure_s, gain_dB, REGION))
    assert (accepted.exposure_s, accepted.gain_dB) == (pytest.approx(exposure_s), gain_dB)


@pytest.mark.parametrize("name", ["BayerRG8", "BayerRG10", "BayerRG10p", "BayerRG12", "BayerRG12p", "BayerRG16"])
def test_samples_are_those_of_the_sensor_in_every_format(camera: U3vCamera, device: VirtualCamera, name: str) -> None:
    camera.configure(SETTINGS)
    assert camera.set_mode(Mode(name)) == Mode(name)
    assert camera.bits == pixel_format(name).bits
    for i, frame in enumerate(camera.frames(3)):
        np.testing.assert_array_equal(frame.data, sent(device, frame, i, name))
    # With 120 samples of 10 or 12 bits the lines do not end on whole bytes of a word.
    camera.configure(Settings(4e-3, 0.0, Region(4, 2, 120, 6)))
    for i, frame in enumerate(camera.frames(2)):
        np.testing.assert_array_equal(frame.data, sent(device, frame, i, name))


@pytest.mark.parametrize("cfa", ["RGGB", "GRBG", "GBRG", "BGGR", "mono"])
def test_every_colour_filter(cfa: str) -> None:
    device = VirtualCamera(CameraModel(cfa=cfa))
    with U3vCamera(backend=VirtualBackend([device])) as camera:
        assert camera.cfa == cfa
        name = next(n for n in camera.features.pixel_formats if n.endswith("12p"))
        camera.set_mode(Mode(name))
        (frame,) = camera.frames(1)
        np.testing.assert_array_equal(frame.data, sent(device, frame, 0, name))
        assert camera.cfa == cfa


def test_frames_carry_ids_times_and_completeness(camera: U3vCamera) -> None:
    camera.configure(SETTINGS)
    camera.set_mode(Mode("BayerRG12p", 50.0))
    frames = list(camera.frames(6))
    assert [f.frame_id for f in frames] == list(range(6))
    np.testing.assert_allclose(np.diff([f.timestamp_s for f in frames]), 0.02, atol=1e-6)
    assert all(f.complete for f in frames)
    assert camera.counts == Counts(delivered=6)


def test_ids_go_on_over_calls(camera: U3vCamera) -> None:
    ids = [[f.frame_id for f in camera.frames(2)] for _ in range(3)]
    assert ids == [[0, 1], [2, 3], [4, 5]]


def test_frames_are_the_callers_own(camera: U3vCamera, device: VirtualCamera) -> None:
    frames = list(camera.frames(80))
    frames[0].data[:] = 7
    for i, frame in enumerate(frames[1:], start=1):
        np.testing.assert_array_equal(frame.data, sent(device, frame, i, "BayerRG8"))


def test_chunks_say_what_each_frame_was_taken_with(camera: U3vCamera, device: VirtualCamera) -> None:
    camera.configure(SETTINGS)
    # Behind the driver's back, so that each frame is exposed differently.
    device._memory.put_uint(at.EXPOSURE_AUTO, 2)
    device._memory.put_uint(at.GAIN_AUTO, 2)
    exposures = [f.settings.exposure_s for f in camera.frames(7)]
    np.testing.assert_allclose(exposures, 7e-3 + 50e-6 * np.arange(7))


def test_camera_without_chunks_gives_the_accepted_settings() -> None:
    with U3vCamera(backend=VirtualBackend([VirtualCamera(CameraModel(chunks=False))])) as camera:
        accepted = camera.configure(SETTINGS)
        assert [f.settings for f in camera.frames(3)] == [accepted] * 3


def test_frames_carry_the_temperature_of_before_they_began(camera: U3vCamera, device: VirtualCamera) -> None:
    camera.configure(SETTINGS)
    assert [frame.temperature_C for frame in camera.frames(2)] == [38.5, 38.5]
    device._memory.put_uint(at.TEMPERATURE_RAW, 2**32 - 20 * 16)  # signed
    assert next(iter(camera.frames(1))).temperature_C == -20.0


def test_a_temperature_that_is_none_ends_no_capture(camera: U3vCamera, device: VirtualCamera) -> None:
    camera.configure(SETTINGS)
    for raw in (2**31 - 1, 2**31):
        device._memory.put_uint(at.TEMPERATURE_RAW, raw)
        assert next(iter(camera.frames(1))).temperature_C is None


def test_a_camera_without_a_temperature_gives_none() -> None:
    with U3vCamera(backend=VirtualBackend([VirtualCamera(CameraModel(temperature=False))])) as camera:
        camera.configure(SETTINGS)
        assert next(iter(camera.frames(1))).temperature_C is None


def test_frame_rate_is_as_asked_or_the_fastest(camera: U3vCamera) -> None:
    camera.configure(Settings(1e-3, 0.0, REGION))
    for asked, period_s in ((25.0, 0.04), (None, 1 / 120)):
        assert camera.set_mode(Mode("BayerRG8", asked)).frame_rate_hz == asked
        np.testing.assert_allclose(np.diff([f.timestamp_s for f in camera.frames(3)]), period_s, atol=1e-6)


def test_slow_frame_rates_are_waited_for(camera: U3vCamera) -> None:
    camera.set_mode(Mode("BayerRG8", 0.1))
    assert len(list(camera.frames(2))) == 2


def test_long_exposures_are_waited_for(camera: U3vCamera) -> None:
    camera.configure(Settings(9.0, 0.0, REGION))
    assert len(list(camera.frames(2))) == 2


def test_software_trigger_exposes_when_a_frame_is_asked_for(camera: U3vCamera, device: VirtualCamera) -> None:
    camera.configure(SETTINGS)
    assert camera.set_mode(Mode("BayerRG12p", None, Trigger.SOFTWARE)).trigger is Trigger.SOFTWARE
    frames = camera.frames(3)
    for i in range(3):
        device.clock.wait_ns(3_000_000_000)
        asked_s = device.clock.now_ns() / 1e9
        frame = next(frames)
        assert frame.timestamp_s >= asked_s
        np.testing.assert_array_equal(frame.data, sent(device, frame, i, "BayerRG12p"))
    with pytest.raises(StopIteration):
        next(frames)


def test_external_trigger_waits_for_a_signal(camera: U3vCamera, device: VirtualCamera) -> None:
    camera.configure(SETTINGS)
    assert camera.set_mode(Mode("BayerRG8", None, Trigger.EXTERNAL)).trigger is Trigger.EXTERNAL
    with pytest.raises(CameraTimeout):
        next(camera.frames(1))


def test_back_to_free_run(camera: U3vCamera) -> None:
    for trigger in (Trigger.SOFTWARE, Trigger.EXTERNAL, Trigger.FREE_RUN):
        assert camera.set_mode(Mode("BayerRG8", None, trigger)).trigger is trigger
    assert len(list(camera.frames(3))) == 3


@pytest.mark.parametrize(
    "settings",
    [
        Settings(1e-6, 0.0, REGION),
        Settings(100.0, 0.0, REGION),
        Settings(float("nan"), 0.0, REGION),
        Settings(4e-3, -1.0, REGION),
        Settings(4e-3, 25.0, REGION),
        Settings(4e-3, float("nan"), REGION),
        Settings(4e-3, 0.0, Region(2, 4, 64, 48)),
        Settings(4e-3, 0.0, Region(8, 4, 63, 48)),
        Settings(4e-3, 0.0, Region(8, 4, 64, 47)),
        Settings(4e-3, 0.0, Region(80, 4, 64, 48)),
        Settings(4e-3, 0.0, Region(8, -2, 64, 48)),
        Settings(4e-3, 0.0, Region(8, 4, 0, 48)),
        Settings(4e-3, 0.0, Region(8, 4, -64, 48)),
    ],
)
def test_refuses_settings_that_it_cannot_do(camera: U3vCamera, settings: Settings) -> None:
    with pytest.raises(CameraError, match=SENTENCE):
        camera.configure(settings)
    assert len(list(camera.frames(1))) == 1


@pytest.mark.parametrize(
    "mode",
    [
        Mode("RGB8"),
        Mode(""),
        Mode("Mono8"),
        Mode("BayerRG8", 1e4),
        Mode("BayerRG8", 0.0),
        Mode("BayerRG8", float("nan")),
    ],
)
def test_refuses_modes_that_it_cannot_do(camera: U3vCamera, mode: Mode) -> None:
    with pytest.raises(CameraError, match=SENTENCE):
        camera.set_mode(mode)
    assert len(list(camera.frames(1))) == 1


def test_everything_but_identity_needs_it_open(device: VirtualCamera) -> None:
    camera = U3vCamera(backend=VirtualBackend([device]))
    for use in (
        lambda: camera.sensor,
        lambda: camera.bits,
        lambda: camera.features,
        lambda: camera.mode,
        lambda: camera.configure(SETTINGS),
        lambda: camera.set_mode(Mode("BayerRG8")),
        lambda: camera.frames(1),
    ):
        with pytest.raises(CameraError, match="closed"):
            use()


def test_is_opened_once(camera: U3vCamera) -> None:
    with pytest.raises(CameraError, match="open already"):
        camera.__enter__()


def test_frames_of_an_earlier_call_end_with_a_sentence(camera: U3vCamera) -> None:
    for interrupt in (
        lambda: camera.configure(SETTINGS),
        lambda: camera.set_mode(Mode("BayerRG8")),
        lambda: list(camera.frames(1)),
    ):
        frames = camera.frames(5)
        next(frames)
        interrupt()
        with pytest.raises(CameraError, match="Ask for frames again"):
            next(frames)


def test_the_device_is_left_stopped_and_free(device: VirtualCamera) -> None:
    backend = VirtualBackend([device])
    with U3vCamera(backend=backend) as camera:
        frames = camera.frames(1000)
        next(frames)
        assert device._acquisition.running
    assert not device._acquisition.running
    assert device._memory.uint(at.SI_CONTROL) == 0
    with pytest.raises(CameraError, match="Ask for frames again"):
        next(frames)
    assert not backend._handles


def test_no_frames_asked_for_starts_nothing(camera: U3vCamera, device: VirtualCamera) -> None:
    assert list(camera.frames(0)) == []
    assert not device._acquisition.running


def test_errors_of_the_caller_leave_it_free(device: VirtualCamera) -> None:
    backend = VirtualBackend([device])

    def fail() -> None:
        with U3vCamera(backend=backend) as camera:
            next(camera.frames(10))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not backend._handles
    with U3vCamera(backend=backend) as camera:
        assert len(list(camera.frames(2))) == 2


def test_a_camera_left_running_by_a_killed_program_is_stopped_first(device: VirtualCamera) -> None:
    killed = U3vCamera(backend=VirtualBackend([device]))
    killed.__enter__()
    killed.set_mode(Mode("BayerRG8", None, Trigger.SOFTWARE))  # no thread is left reading
    frames = killed.frames(1000)
    next(frames)
    assert device._acquisition.running
    with U3vCamera(backend=VirtualBackend([device])) as camera:
        assert camera.mode.trigger is Trigger.SOFTWARE
        camera.set_mode(Mode("BayerRG12p"))
        for i, frame in enumerate(camera.frames(4)):
            assert frame.complete
            np.testing.assert_array_equal(frame.data, sent(device, frame, i, "BayerRG12p"))


def test_at_a_usb_2_port_it_works_too() -> None:
    device = VirtualCamera(speed=Speed.HIGH)
    with U3vCamera(backend=VirtualBackend([device])) as camera:
        camera.set_mode(Mode("BayerRG12"))
        for i, frame in enumerate(camera.frames(3)):
            np.testing.assert_array_equal(frame.data, sent(device, frame, i, "BayerRG12"))


@pytest.mark.parametrize("alignment", [1, 4, 512, 1024, 8192])
def test_every_alignment_of_transfers(alignment: int) -> None:
    device = VirtualCamera(CameraModel(alignment=alignment))
    with U3vCamera(backend=VirtualBackend([device])) as camera:
        camera.set_mode(Mode("BayerRG12p"))
        for i, frame in enumerate(camera.frames(3)):
            np.testing.assert_array_equal(frame.data, sent(device, frame, i, "BayerRG12p"))


@pytest.mark.parametrize("max_transfer", [48, 76, 128, 65_536])
def test_every_length_of_messages(max_transfer: int) -> None:
    with U3vCamera(backend=VirtualBackend([VirtualCamera(CameraModel(max_transfer=max_transfer))])) as camera:
        assert camera.configure(SETTINGS).region == REGION


def test_pictures_of_more_than_one_transfer() -> None:
    device = VirtualCamera(CameraModel(columns=2048, rows=1536))
    with U3vCamera(backend=VirtualBackend([device])) as camera:
        camera.set_mode(Mode("BayerRG12p"))
        for i, frame in enumerate(camera.frames(3)):
            np.testing.assert_array_equal(frame.data, sent(device, frame, i, "BayerRG12p"))
            time.sleep(0.02)  # the reader goes on meanwhile
