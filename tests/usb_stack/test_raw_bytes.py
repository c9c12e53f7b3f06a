"""The virtual camera through libusb, usbfs and a host-controller driver, byte by byte."""

from __future__ import annotations

import errno
import struct
import time
from array import array

import numpy as np
import pytest
import usb.backend.libusb1
import usb.core
import usb.util

from tests.usb_stack.vhci import PlugIn
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.clock import WallClock
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.model import CameraModel, Speed
from tests.virtual_u3v.raw_host import CONTROL_IN, STREAM_IN, RawHost
from tests.virtual_u3v.sources import PATTERN_PERIOD, Exposure, PatternSource

FULL = CameraModel(columns=2048, rows=1536, exposure_us=(20.0, 1e6), frame_rate_hz=(0.1, 1000.0))


def camera(model: CameraModel | None = None, speed: Speed = Speed.SUPER, faults: Faults | None = None) -> VirtualCamera:
    return VirtualCamera(model, speed=speed, faults=faults, clock=WallClock())


def find() -> usb.core.Device | None:
    import libusb_package

    backend = usb.backend.libusb1.get_backend(find_library=libusb_package.find_library)
    return usb.core.find(backend=backend, custom_match=lambda d: d.bDeviceClass == 0xEF)


def gone_within(limit_s: float) -> bool:
    """Whether libusb, which learns of it from the kernel in a thread of its own, has lost sight of the camera."""
    end = time.monotonic() + limit_s
    while find() is not None and time.monotonic() < end:
        time.sleep(0.02)
    return find() is None


def host() -> RawHost:
    device = find()
    assert device is not None
    return RawHost(device)


@pytest.mark.parametrize("speed", [Speed.SUPER, Speed.HIGH])
def test_kernel_and_libusb_see_the_camera_and_its_speed(plug_in: PlugIn, speed: Speed) -> None:
    plug_in(camera(speed=speed))
    found = host()
    assert found.device.speed == speed
    assert found.device[0][(2, 0)][0].wMaxPacketSize == speed.packet_size
    info = bytes(found.device[0][(0, 0)].extra_descriptors)
    assert info[1:3] == b"\x24\x01"
    assert found.readmem(0x144, 64).data.rstrip(b"\0") == b"V0000001"
    usb.util.dispose_resources(found.device)


def test_full_size_frames_come_bit_for_bit(plug_in: PlugIn, capsys: pytest.CaptureFixture[str]) -> None:
    plug_in(camera(FULL))
    found = host()
    assert [found.set(r, v) for r, v in ((at.EXPOSURE_AUTO, 0), (at.EXPOSURE_TIME_RAW, 1000))] == [0, 0]
    expected = [payload(phase) for phase in range(PATTERN_PERIOD)]
    sizes = found.start()
    rooms = [array("B", bytes(size)) for size in (sizes.leader, *sizes.payload, sizes.trailer)]
    count, spent_s = 100, 0.0
    for block_id in range(count):
        begun = time.monotonic()
        lengths = [found.device.read(STREAM_IN, room, 20_000) for room in rooms]
        spent_s += time.monotonic() - begun
        assert lengths == [52, *sizes.payload, 32]
        assert struct.unpack_from("<Q", rooms[0], 8) == struct.unpack_from("<Q", rooms[-1], 8) == (block_id,)
        assert b"".join(rooms[1:-1]) == expected[block_id % PATTERN_PERIOD]
    found.stop()
    usb.util.dispose_resources(found.device)
    with capsys.disabled():
        print(f"\nlibusb and usbfs alone: {count / spent_s:.1f} frames of {len(expected[0]) / 1e6:.1f} MB per second")


def payload(block_id: int) -> bytes:
    mosaic = PatternSource()(Exposure(block_id, 0, 100.0, 0, FULL.bits, 0, 0, FULL.columns, FULL.rows))
    return (mosaic >> 4).astype(np.uint8).tobytes()


def test_commands_do_not_starve_while_a_stream_read_waits(plug_in: PlugIn) -> None:
    plug_in(camera())
    found = host()
    found.set(at.TRIGGER_MODE, 1)
    found.start()
    with pytest.raises(usb.core.USBTimeoutError):
        found.device.read(STREAM_IN, 1024, 100)
    begun = time.monotonic()
    assert found.get(at.WIDTH) == 128
    assert time.monotonic() - begun < 1.0
    assert found.set(at.TRIGGER_SOFTWARE, 1) == 0
    assert bytes(found.device.read(STREAM_IN, 1024, 1000))[:4] == b"U3VL"
    usb.util.dispose_resources(found.device)


def test_time_outs_halts_and_babble_are_the_kernels_own(plug_in: PlugIn) -> None:
    made = camera()
    plug_in(made)
    found = host()
    with pytest.raises(usb.core.USBTimeoutError):
        found.device.read(CONTROL_IN, 1024, 50)
    made.inject(Faults(control_halts=1))
    for _ in range(2):
        with pytest.raises(usb.core.USBError) as error:
            found.readmem(0, 4)
        assert error.value.errno == errno.EPIPE
    found.device.clear_halt(CONTROL_IN)
    assert found.acknowledge().request_id == 2
    made.inject(Faults(babble_frames=(0,)))
    found.start(4096)
    assert bytes(found.device.read(STREAM_IN, 1024, 1000))[:4] == b"U3VL"
    assert len(found.device.read(STREAM_IN, 4096, 1000)) == 4096
    with pytest.raises(usb.core.USBError) as error:
        found.device.read(STREAM_IN, 4096, 1000)
    assert error.value.errno == errno.EOVERFLOW
    usb.util.dispose_resources(found.device)


def test_unplugged_camera_is_gone_at_once_and_comes_back(plug_in: PlugIn) -> None:
    made = camera(faults=Faults(unplug_at_frame=1))
    plug = plug_in(made)
    found = host()
    sizes = found.start(4096)
    assert found.frame(sizes).block_ids == (0, 0)
    begun = time.monotonic()
    with pytest.raises(usb.core.USBError) as error:
        found.frame(sizes, 5000)
    assert error.value.errno in (errno.ENODEV, errno.EIO, errno.EPIPE)
    assert time.monotonic() - begun < 5.0
    plug.pull()
    usb.util.dispose_resources(found.device)
    assert gone_within(2.0)
    made.inject(Faults())
    plug_in(made)
    again = host()
    assert again.frame(again.start(4096)).block_ids == (0, 0)
    assert struct.unpack_from("<I", again.readmem(at.WIDTH.address, 4).data)[0] == 128
    usb.util.dispose_resources(again.device)
