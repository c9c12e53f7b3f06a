"""Frames of the virtual camera, byte by byte, without the driver."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import usb.control
import usb.core
import usb.util

from tests.cameras.u3v.device_host import exposure, host_of, manual, unpacked
from tests.simulation.toy import toy_truth
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.memory import Status
from tests.virtual_u3v.model import CameraModel
from tests.virtual_u3v.pixel_formats import PixelFormat, delivered, formats_of
from tests.virtual_u3v.rig_source import RigSource, model_of_rig
from tests.virtual_u3v.sources import Exposure, PatternSource
from udccal.arrangements import FlatLight
from udccal.simulation.world import SimulatedWorld


@pytest.mark.parametrize("pixel_format", formats_of(CameraModel()), ids=lambda f: f.name)
def test_frames_are_what_the_source_made(pixel_format: PixelFormat) -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    host.set(at.PIXEL_FORMAT, pixel_format.code)
    sizes = host.start(8192)
    for block_id in range(6):
        frame = host.frame(sizes)
        assert frame.block_ids == (block_id, block_id)
        assert struct.unpack_from("<H", frame.leader, 18)[0] == 0x0001
        assert struct.unpack_from("<I", frame.leader, 28)[0] == pixel_format.code
        mosaic = PatternSource()(exposure(frame, camera))
        expected = delivered(mosaic, camera.model.bits, pixel_format.bits)
        np.testing.assert_array_equal(unpacked(frame.payload, pixel_format, mosaic.shape), expected)


def test_pattern_tells_places_and_frames_apart() -> None:
    source = PatternSource()
    whole = source(Exposure(0, 0, 1.0, 0, 12, 0, 0, 128, 96))
    part = source(Exposure(0, 0, 1.0, 0, 12, 8, 4, 64, 48))
    later = source(Exposure(1, 0, 1.0, 0, 12, 0, 0, 128, 96))
    np.testing.assert_array_equal(part, whole[4:52, 8:72])
    assert (whole == later).mean() < 0.01
    assert (whole[:, 1:] == whole[:, :-1]).mean() < 0.01
    assert whole.max() > 4000


def test_region_and_times_are_in_the_leader() -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    manual(host)
    for register, value in ((at.WIDTH, 64), (at.HEIGHT, 48), (at.OFFSET_X, 8), (at.OFFSET_Y, 4)):
        assert host.set(register, value) == 0
    sizes = host.start()
    frames = [host.frame(sizes) for _ in range(3)]
    assert struct.unpack_from("<4I", frames[0].leader, 32) == (64, 48, 8, 4)
    np.testing.assert_allclose(np.diff([f.timestamp_ns for f in frames]), 1e9 / 120, atol=1)
    assert len(frames[0].payload) == 64 * 48


def test_frames_of_a_simulated_rig_are_the_rigs() -> None:
    def world() -> SimulatedWorld:
        made = SimulatedWorld(toy_truth(), seed=3)
        made.arrange(FlatLight())
        return made

    camera = VirtualCamera(model_of_rig(world()), RigSource(world()))
    host = host_of(camera)
    manual(host)
    host.set(at.PIXEL_FORMAT, next(f.code for f in formats_of(camera.model) if f.name.endswith("12")))
    frame = host.frame(host.start())
    settings = exposure(frame, camera, gain_steps=host.get(at.GAIN_RAW)).settings
    expected = world().develop(world().rate_during(settings, 0.0), settings, 0)
    np.testing.assert_array_equal(np.frombuffer(frame.payload, "<u2").reshape(expected.shape), expected)


def test_chunks_say_what_the_frame_was_taken_with() -> None:
    host = host_of(VirtualCamera())
    assert [host.set(r, 1) for r in (at.CHUNK_MODE_ACTIVE, *at.CHUNK_ENABLE)] == [0] * 6
    sizes = host.start()
    exposures = []
    for _ in range(3):
        frame = host.frame(sizes)
        assert struct.unpack_from("<H", frame.leader, 18)[0] == 0x4001
        values, rest = {}, frame.payload
        while rest:
            identifier, length = struct.unpack("<II", rest[-8:])
            values[identifier] = rest[-8 - length : -8]
            rest = rest[: -8 - length]
        assert len(values[1]) == 128 * 96
        exposures.append(struct.unpack("<d", values[0xA001])[0])
        assert struct.unpack("<Q", values[0xA003])[0] == frame.timestamp_ns
        assert struct.unpack("<Q", values[0xA004])[0] == frame.block_ids[0]
    assert exposures == [7000.0, 7050.0, 7100.0]  # the automatic is still on


def test_waits_for_its_triggers() -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    host.set(at.TRIGGER_MODE, 1)
    sizes = host.start()
    with pytest.raises(usb.core.USBTimeoutError):
        host.frame(sizes)
    assert host.set(at.TRIGGER_SOFTWARE, 1) == 0
    assert host.frame(sizes).block_ids[0] == 0
    with pytest.raises(usb.core.USBTimeoutError):
        host.frame(sizes)
    assert host.set(at.TRIGGER_SOURCE, 1) == 0
    assert host.set(at.TRIGGER_SOFTWARE, 1) == Status.ACCESS_DENIED
    camera.pulse()
    assert host.frame(sizes).block_ids[0] == 1


def test_takes_as_many_frames_as_asked() -> None:
    host = host_of(VirtualCamera())
    host.set(at.ACQUISITION_MODE, 2)
    host.set(at.ACQUISITION_FRAME_COUNT, 3)
    sizes = host.start()
    assert [host.frame(sizes).block_ids[0] for _ in range(3)] == [0, 1, 2]
    with pytest.raises(usb.core.USBTimeoutError):
        host.frame(sizes)


def test_frame_rate_is_kept_when_asked_for() -> None:
    host = host_of(VirtualCamera())
    host.writemem(at.ACQUISITION_FRAME_RATE.address, struct.pack("<d", 10.0))
    host.set(at.ACQUISITION_FRAME_RATE_ENABLE, 1)
    sizes = host.start()
    times = [host.frame(sizes).timestamp_ns for _ in range(3)]
    np.testing.assert_allclose(np.diff(times), 1e8, atol=1)
