"""The pieces of the pylon backend on devices that the emulated camera cannot be."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cameras import fake_pylon
from tests.cameras.backends import picture
from tests.cameras.fake_pylon import Choice, DeviceInfo, Factory, Genicam, InstantCamera, NodeMap, NoResult, Number
from udccal.cameras.protocol import Mode, Range, Region, Settings, Trigger
from udccal.cameras.pylon_sdk import controls
from udccal.cameras.pylon_sdk.devices import OpenDevice, open_device
from udccal.cameras.pylon_sdk.frame_ids import FrameIds
from udccal.cameras.pylon_sdk.grabbing import retrieve
from udccal.cameras.pylon_sdk.loading import Sdk
from udccal.cameras.pylon_sdk.nodes import Nodes
from udccal.cameras.pylon_sdk.raw_samples import send_chunks, send_raw_samples
from udccal.errors import CameraBusy, CameraError, CameraLost, CameraTimeout


def device(camera: InstantCamera) -> OpenDevice:
    return OpenDevice(Sdk(Factory(camera), Genicam()), camera, Nodes(NodeMap()))


# --- features


def older_camera(**more: Number | Choice) -> NodeMap:
    """A GigE camera from before SFNC 2.0: exposure and rate end in Abs, the gain has no unit."""
    nodes = {
        "ExposureTimeAbs": Number(10_000.0, 20.0, 1e6),
        "AcquisitionFrameRateAbs": Number(30.0, 0.5, 60.0),
        "AcquisitionFrameRateEnable": Choice(True),
        "GainRaw": Number(300, 192, 1023),
        "Width": Number(640, 16, 640, 8),
        "Height": Number(480, 16, 480, 1),
        "WidthMax": Number(645),
        "HeightMax": Number(483),
        "OffsetX": Number(0, 0, 640, 4),
        "OffsetY": Number(0, 0, 480, 3),
        "PixelFormat": Choice("YUV422", ("YUV422", "BayerRG12Packed", "Mono8")),
        "GevTimestampTickFrequency": Number(125_000_000),
    }
    return NodeMap(**{**nodes, **more})


def test_older_names_are_found() -> None:
    nodes = Nodes(older_camera())
    features = controls.read_features(nodes)
    assert (features.exposure_s, features.gain_dB) == (Range(2e-5, 1.0), Range(0.0, 0.0))
    assert features.frame_rate_hz == Range(0.5, 60.0)
    assert features.region_steps == (4, 6, 8, 2)
    assert features.pixel_formats == ("BayerRG12Packed", "Mono8")
    assert features.triggers == (Trigger.FREE_RUN,)
    assert controls.read_sensor(nodes) == Region(0, 0, 644, 482)
    assert controls.ticks_per_s(nodes) == 125e6


def test_the_temperature_is_that_of_the_sensor_or_of_an_older_name() -> None:
    place = Choice("Coreboard", ("Coreboard", "Sensorboard"))
    newer = NodeMap(DeviceTemperatureSelector=place, DeviceTemperature=Number(41.0))
    assert controls.read_temperature(Nodes(newer)) == 41.0
    assert place.value == "Sensorboard"
    assert controls.read_temperature(Nodes(older_camera(TemperatureAbs=Number(44.5)))) == 44.5
    assert controls.read_temperature(Nodes(older_camera(TemperatureAbs=Number(float("nan"))))) is None
    assert controls.read_temperature(Nodes(older_camera())) is None


def test_a_gain_without_a_unit_is_set_to_its_least() -> None:
    node_map = older_camera()
    controls.write_settings(Nodes(node_map), Settings(0.02, 0.0, Region(8, 6, 320, 240)))
    assert node_map.nodes["GainRaw"].value == 192
    assert controls.read_settings(Nodes(node_map)) == Settings(0.02, 0.0, Region(8, 6, 320, 240))


@pytest.mark.parametrize(("low_us", "high_us"), [(20.0, 16_777_215.0), (0.3, 123.0)])
def test_both_ends_of_the_exposures_are_accepted(low_us: float, high_us: float) -> None:
    nodes = Nodes(older_camera(ExposureTimeAbs=Number(50.0, low_us, high_us)))
    exposures = controls.read_features(nodes).exposure_s
    for exposure_s, exposure_us in ((exposures.low, low_us), (exposures.high, high_us)):
        controls.write_settings(nodes, Settings(exposure_s, 0.0, Region(0, 0, 640, 480)))
        assert nodes.number("ExposureTimeAbs") == exposure_us


def test_mono_of_a_colour_sensor_is_no_raw_format() -> None:
    nodes = Nodes(older_camera(PixelColorFilter=Choice("BayerRG", ("BayerRG",))))
    assert controls.read_features(nodes).pixel_formats == ("BayerRG12Packed",)


def test_a_rate_without_a_switch_is_always_held() -> None:
    node_map = older_camera()
    del node_map.nodes["AcquisitionFrameRateEnable"]
    nodes = Nodes(node_map)
    controls.write_mode(nodes, Mode("Mono8", 15.0))
    assert controls.read_mode(nodes) == Mode("Mono8", 15.0)
    assert controls.frame_period_s(nodes) == pytest.approx(1 / 15)
    controls.write_mode(nodes, Mode("Mono8"))
    assert controls.read_mode(nodes).frame_rate_hz == 60.0


def test_triggers_are_told_apart() -> None:
    node_map = older_camera(
        TriggerSelector=Choice("FrameStart", ("AcquisitionStart", "FrameStart")),
        TriggerMode=Choice("Off", ("Off", "On")),
        TriggerSource=Choice("Line1", ("Software", "Line1", "Line3")),
    )
    nodes = Nodes(node_map)
    assert controls.read_features(nodes).triggers == (Trigger.FREE_RUN, Trigger.SOFTWARE, Trigger.EXTERNAL)
    for trigger, source in ((Trigger.SOFTWARE, "Software"), (Trigger.EXTERNAL, "Line1")):
        controls.write_mode(nodes, Mode("Mono8", trigger=trigger))
        assert (nodes.text("TriggerSource"), nodes.text("TriggerMode")) == (source, "On")
        assert controls.read_mode(nodes).trigger is trigger
    node_map.nodes["TriggerSource"].value = "Line3"  # as a feature file may say
    controls.write_mode(nodes, Mode("Mono8", trigger=Trigger.EXTERNAL))
    assert nodes.text("TriggerSource") == "Line3"
    controls.write_mode(nodes, Mode("Mono8"))
    assert controls.read_mode(nodes).trigger is Trigger.FREE_RUN


def test_preparing_passes_over_what_a_device_does_not_have() -> None:
    nodes = Nodes(NodeMap())
    send_raw_samples(nodes)
    send_chunks(nodes)
    assert nodes.number("ExposureTime") is None
    assert nodes.flag("GammaEnable") is None
    assert (nodes.text("PixelFormat"), nodes.choices("PixelFormat"), nodes.step("Width")) == ("", (), 1)
    assert not nodes.choose("PixelFormat", "Mono8")


def test_nodes_of_an_unexpected_kind_are_as_good_as_absent() -> None:
    nodes = Nodes(NodeMap(ExposureTime=Choice("Long", ("Long",)), PixelFormat=Number(8)))
    assert nodes.number("ExposureTime") is None
    assert nodes.bounds("ExposureTime") is None
    assert nodes.choices("PixelFormat") == ()


def test_chunks_are_switched_on_where_a_device_has_them() -> None:
    chosen: list[str] = []

    class Selector:
        def __getattr__(self, name: str) -> object:
            return getattr(Choice("Image", ("Image", "Timestamp", "ExposureTime")), name)

        def SetValue(self, value: str) -> None:
            chosen.append(value)

    node_map = NodeMap(ChunkModeActive=Choice(False), ChunkEnable=Choice(False))
    node_map.nodes["ChunkSelector"] = Selector()  # type: ignore[assignment]
    send_chunks(Nodes(node_map))
    assert chosen == ["ExposureTime", "Timestamp"]
    assert node_map.nodes["ChunkModeActive"].value is True
    assert node_map.nodes["ChunkEnable"].value is True


# --- grabbing


def test_chunks_go_before_what_the_sdk_says() -> None:
    chunks = NodeMap(ChunkExposureTime=Number(1234.5), ChunkTimestamp=Number(77), ChunkGain=Number(1.5))
    result = fake_pylon.Result(picture(4, 6), chunks, ticks=5, block_id=9)
    grabbed = retrieve(device(InstantCamera(result)), 1.0)
    assert grabbed.data is not None
    np.testing.assert_array_equal(grabbed.data, picture(4, 6))
    assert (grabbed.exposure_s, grabbed.ticks, grabbed.gain_dB) == (pytest.approx(1.2345e-3), 77, 1.5)
    assert result.released
    bare = retrieve(device(InstantCamera(fake_pylon.Result(picture(4, 6), None, ticks=5))), 1.0)
    assert (bare.exposure_s, bare.ticks, bare.gain_dB) == (None, 5, None)


def test_a_result_is_released_when_its_samples_cannot_be_read() -> None:
    result = fake_pylon.Result(picture(4, 6))
    result.GetWidth = lambda: 1000  # type: ignore[method-assign]
    with pytest.raises(CameraError, match="Expected 8000 bytes"):
        retrieve(device(InstantCamera(result)), 1.0)
    assert result.released


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        (InstantCamera(fake_pylon.TimeoutException("x")), CameraTimeout),
        (InstantCamera(fake_pylon.GenericException("x"), removed_after=2), CameraLost),
        (InstantCamera(fake_pylon.GenericException("x"), removed_after=None), CameraError),
        (InstantCamera(NoResult(), removed_after=0), CameraLost),
        (InstantCamera(NoResult()), CameraError),
    ],
)
def test_every_end_of_a_stream_has_its_error(camera: InstantCamera, expected: type[CameraError]) -> None:
    with pytest.raises(CameraError, match=r"Expected a frame.*, found .*\. [A-Z]") as caught:
        retrieve(device(camera), 0.01)
    assert type(caught.value) is expected


def test_reasons_are_short() -> None:
    error = fake_pylon.GenericException("Line one\n of two. : RuntimeException thrown (file 'x.cpp')" + "x" * 5000)
    with pytest.raises(CameraError, match=r"refused: Line one of two\. Check") as caught:
        retrieve(device(InstantCamera(error)), 0.01)
    assert len(str(caught.value)) < 300


# --- opening


@pytest.mark.parametrize(
    ("why", "error", "found"),
    [(2, CameraBusy, "another program"), (3, CameraBusy, "another program"), (4, CameraLost, "cannot be reached")],
)
def test_a_camera_that_may_not_be_opened_is_busy_or_lost(why: int, error: type[CameraError], found: str) -> None:
    sdk = Sdk(Factory(InstantCamera(), accessible=(False, why)), Genicam())
    with pytest.raises(error, match=rf"Expected to open the camera 0042, found .*{found}.*\. (Close|Plug)"):
        open_device(sdk, DeviceInfo())


def test_a_camera_that_does_not_open_is_busy() -> None:
    sdk = Sdk(Factory(InstantCamera(fake_pylon.GenericException("The device is controlled elsewhere."))), Genicam())
    with pytest.raises(CameraBusy, match=r"found: The device is controlled elsewhere\. Close"):
        open_device(sdk, DeviceInfo())


# --- frame ids


def numbered(*blocks: int) -> list[tuple[int, int]]:
    ids = FrameIds()
    return [ids.next(block, index) for index, block in enumerate(blocks, start=1)]


def test_gaps_in_block_ids_are_frames_that_never_came() -> None:
    assert numbered(0, 1, 4, 5) == [(0, 0), (1, 0), (4, 2), (5, 0)]
    assert numbered(1, 2, 4) == [(0, 0), (1, 0), (3, 1)]


def test_sixteen_bit_block_ids_go_on_after_their_last() -> None:
    assert numbered(65533, 65534, 65535, 1, 2) == [(index, 0) for index in range(5)]
    assert numbered(65534, 2) == [(0, 0), (3, 2)]


def test_devices_that_do_not_count_are_counted_for() -> None:
    assert numbered(0, 0, 0) == [(0, 0), (1, 0), (2, 0)]
    assert numbered(*[2**64 - 1] * 3) == [(0, 0), (1, 0), (2, 0)]


def test_numbers_go_on_from_stream_to_stream() -> None:
    ids = FrameIds()
    first = [ids.next(block, index) for index, block in enumerate((7, 9), start=1)]
    ids.begin_stream()
    second = [ids.next(block, index) for index, block in enumerate((0, 1), start=1)]
    assert [*first, *second] == [(0, 0), (2, 1), (3, 0), (4, 0)]


def test_a_block_that_comes_twice_keeps_its_number() -> None:
    assert numbered(1, 2, 2, 3) == [(0, 0), (1, 0), (1, 0), (2, 0)]
