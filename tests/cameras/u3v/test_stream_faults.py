"""Frames that are broken, lost, late or repeated."""

from __future__ import annotations

import errno
import struct

import numpy as np
import pytest
import usb.core

from tests.cameras.u3v.small_frames import REGION, SENTENCE, check_whole
from tests.virtual_u3v import manifest
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.description import description_of
from tests.virtual_u3v.descriptors import STREAM_IN
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.memory import Memory
from tests.virtual_u3v.model import CameraModel
from udccal.cameras.protocol import Counts, Mode, Settings, Trigger
from udccal.cameras.u3v.acquisition import frame_wait_s
from udccal.cameras.u3v.camera import U3vCamera
from udccal.errors import CameraProtocolError, CameraTimeout


@pytest.mark.parametrize(
    "faults",
    [
        Faults(missing_trailers=(2,)),
        Faults(wrong_block_ids=(2,)),
        Faults(short_frames=(2,)),
        Faults(lying_frames=(2,)),
        Faults(long_frames=(2,)),
        Faults(babble_frames=(2,)),
        Faults(stream_halts=(2,)),
    ],
)
def test_broken_frames_are_marked_and_the_others_whole(
    camera: U3vCamera, device: VirtualCamera, faults: Faults
) -> None:
    device.inject(faults)
    frames = list(camera.frames(6))
    check_whole(frames, {0: 0, 1: 1, 3: 3, 4: 4, 5: 5})
    assert [f.frame_id for f in frames] == list(range(6))
    assert camera.counts == Counts(delivered=6, incomplete=1, dropped=0)


@pytest.mark.parametrize("name", ["BayerRG8", "BayerRG10p", "BayerRG12", "BayerRG12p"])
def test_samples_that_are_missing_are_0_and_the_others_are_right(
    camera: U3vCamera, device: VirtualCamera, name: str
) -> None:
    camera.set_mode(Mode(name))
    (whole,) = camera.frames(1)
    device.inject(Faults(lying_frames=(0,)))
    (frame,) = camera.frames(1)
    came = frame.data.size // 2
    assert not frame.complete
    # The half may end within a word of samples.
    np.testing.assert_array_equal(frame.data.ravel()[: came - 30], whole.data.ravel()[: came - 30])
    assert not frame.data.ravel()[came + 30 :].any()
    assert whole.data.ravel()[came + 30 :].any()


@pytest.mark.parametrize("faults", [Faults(dropped_frames=(2, 3)), Faults(missing_leaders=(2, 3))])
def test_frames_that_never_come_are_counted(camera: U3vCamera, device: VirtualCamera, faults: Faults) -> None:
    device.inject(faults)
    frames = list(camera.frames(5))
    check_whole(frames, {0: 0, 1: 1, 2: 4, 3: 5, 4: 6})
    assert [f.frame_id for f in frames] == [0, 1, 4, 5, 6]
    assert camera.counts == Counts(delivered=5, incomplete=0, dropped=2)
    assert [f.frame_id for f in camera.frames(2)] == [7, 8]


def test_repeated_frames_are_delivered_once(camera: U3vCamera, device: VirtualCamera) -> None:
    device.inject(Faults(duplicated_frames=(1, 3)))
    frames = list(camera.frames(5))
    assert [f.frame_id for f in frames] == [0, 1, 2, 3, 4]
    check_whole(frames, {i: i for i in range(5)})


def test_many_troubles_one_after_the_other(camera: U3vCamera, device: VirtualCamera) -> None:
    device.inject(
        Faults(
            missing_trailers=(1, 9),
            stream_halts=(2, 10),
            babble_frames=(3, 11),
            long_frames=(4, 12),
            missing_leaders=(5,),
            lying_frames=(6,),
            dropped_frames=(7,),
        )
    )
    frames = list(camera.frames(13))
    assert [f.frame_id for f in frames] == [0, 1, 2, 3, 4, 6, 8, 9, 10, 11, 12, 13, 14]
    assert [f.frame_id for f in frames if f.complete] == [0, 8, 13, 14]
    assert camera.counts == Counts(delivered=13, incomplete=9, dropped=2)


def test_a_camera_that_falls_silent_in_a_frame(camera: U3vCamera, device: VirtualCamera) -> None:
    device.inject(Faults(hang_at_frame=2))
    frames = camera.frames(5)
    check_whole([next(frames) for _ in range(3)], {0: 0, 1: 1})
    with pytest.raises(CameraTimeout, match=SENTENCE):
        next(frames)
    device.inject(Faults())
    check_whole(list(camera.frames(2)), {0: 0, 1: 1})


def test_a_camera_that_sends_nothing_times_out_within_exposure_and_time_out(
    camera: U3vCamera, device: VirtualCamera
) -> None:
    camera.set_mode(Mode("BayerRG8", None, Trigger.EXTERNAL))
    camera.configure(Settings(1.0, 0.0, REGION))
    before_ns = device.clock.now_ns()
    with pytest.raises(CameraTimeout, match=SENTENCE):
        next(camera.frames(1))
    assert 3.0 <= 1e-9 * (device.clock.now_ns() - before_ns) < 3.7


class PulsingClock:
    """Each time that the host waits in vain for a frame, there is a signal at the trigger input."""

    def __init__(self) -> None:
        self.now = 0
        self.device: VirtualCamera | None = None

    def now_ns(self) -> int:
        return self.now

    def wait_ns(self, duration_ns: int) -> None:
        self.now += max(0, duration_ns)
        if self.device is not None:
            self.device.pulse()


def test_signals_at_the_trigger_input_make_frames() -> None:
    clock = PulsingClock()
    device = VirtualCamera(clock=clock)
    clock.device = device
    with U3vCamera(backend=VirtualBackend([device])) as camera:
        camera.set_mode(Mode("BayerRG12p", None, Trigger.EXTERNAL))
        check_whole(list(camera.frames(3)), {0: 0, 1: 1, 2: 2})


def test_failed_transfers_of_the_bus_cost_a_frame(
    camera: U3vCamera, device: VirtualCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, reads = VirtualBackend.bulk_read, iter(range(10_000))

    def failing(self: VirtualBackend, dev_handle: object, ep: int, *rest: object) -> int:
        if ep == STREAM_IN and next(reads) == 4:  # payload of the second frame
            raise usb.core.USBError("Input/output error", -1, errno.EIO)
        return read(self, dev_handle, ep, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(VirtualBackend, "bulk_read", failing)
    assert [(f.frame_id, f.complete) for f in camera.frames(3)] == [(0, True), (1, False), (2, True)]


def test_frames_of_another_size_than_agreed_are_refused(camera: U3vCamera, device: VirtualCamera) -> None:
    frames = camera.frames(40)
    next(frames)
    device._memory.put_uint(at.HEIGHT, 46)
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        list(frames)


@pytest.mark.parametrize("faults", [Faults(dropped_frames=(0, 1)), Faults(missing_leaders=(0, 1))])
def test_frames_lost_before_the_first_are_counted(camera: U3vCamera, device: VirtualCamera, faults: Faults) -> None:
    device.inject(faults)
    frames = list(camera.frames(2))
    assert [f.frame_id for f in frames] == [2, 3]
    assert camera.counts == Counts(delivered=2, dropped=2)
    device.inject(faults)
    assert [f.frame_id for f in camera.frames(1)] == [6]
    assert camera.counts == Counts(delivered=3, dropped=4)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0])
def test_a_camera_that_says_it_makes_no_frames_is_refused(
    camera: U3vCamera, device: VirtualCamera, rate_hz: float
) -> None:
    device._memory.put_uint(at.ACQUISITION_FRAME_RATE_ENABLE, 1)
    device._memory.put(at.ACQUISITION_FRAME_RATE, struct.pack("<d", rate_hz))
    with pytest.raises(CameraProtocolError, match=SENTENCE):
        next(camera.frames(1))


@pytest.mark.parametrize(
    ("exposure_s", "rate_hz", "trigger", "wait_s"),
    [
        (4e-3, None, Trigger.FREE_RUN, 2.004),
        (4e-3, 0.1, Trigger.FREE_RUN, 12.0),
        (4e-3, 0.1, Trigger.SOFTWARE, 2.004),
        (30.0, 0.1, Trigger.FREE_RUN, 32.0),
        (4e-3, 1e-12, Trigger.FREE_RUN, 122.004),
        (1e12, None, Trigger.FREE_RUN, 3602.0),
        (1e12, 1e-12, Trigger.FREE_RUN, 3722.0),
    ],
)
def test_waits_are_bounded_whatever_the_camera_says(
    exposure_s: float, rate_hz: float | None, trigger: Trigger, wait_s: float
) -> None:
    settings, mode = Settings(exposure_s, 0.0, REGION), Mode("BayerRG8", rate_hz, trigger)
    assert frame_wait_s(settings, mode, 2.0) == pytest.approx(wait_s)


def test_a_start_that_is_reported_as_running_while_frames_come_is_a_start(
    device: VirtualCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    def description(model: CameraModel) -> str:
        # As in a camera whose register of the command holds 1 for as long as it takes frames.
        command = f"<Address>0x{at.ACQUISITION_START.address:08X}</Address><Length>4</Length>"
        writable = f"{command}<AccessMode>WO"
        text = description_of(model)
        assert writable in text
        return text.replace(writable, f"{command}<AccessMode>RW")

    def read(self: Memory, address: int, length: int) -> bytes:
        if address == at.ACQUISITION_START.address:
            return struct.pack("<I", device._acquisition.running)
        return memory_read(self, address, length)

    memory_read = Memory.read
    monkeypatch.setattr(manifest, "description_of", description)
    monkeypatch.setattr(Memory, "read", read)
    device.unplug()
    device.plug()
    with U3vCamera(backend=VirtualBackend([device])) as camera:
        assert [frame.complete for frame in camera.frames(2)] == [True, True]
