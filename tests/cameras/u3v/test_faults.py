"""The driver on a virtual camera that misbehaves in every way that it knows."""

from __future__ import annotations

import errno
import struct
from collections.abc import Iterator

import numpy as np
import pytest
import usb.core

from tests.virtual_u3v import registers as at
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.descriptors import STREAM_IN
from tests.virtual_u3v.faults import FOREVER, DescriptionFault, Faults
from tests.virtual_u3v.memory import Status
from tests.virtual_u3v.model import CameraModel
from tests.virtual_u3v.sources import Exposure, PatternSource
from udccal.cameras.protocol import Counts, Frame, Mode, Region, Settings, Trigger
from udccal.cameras.u3v.acquisition import frame_wait_s
from udccal.cameras.u3v.camera import U3vCamera
from udccal.cameras.u3v.nodes import NodeMap
from udccal.errors import CameraBusy, CameraError, CameraLost, CameraProtocolError, CameraTimeout

SENTENCE = r"Expected .* found.*\. \w+"
REGION = Region(8, 4, 64, 48)
SETTINGS = Settings(4e-3, 3.0, REGION)


@pytest.fixture
def camera(device: VirtualCamera) -> Iterator[U3vCamera]:
    with U3vCamera(backend=VirtualBackend([device])) as opened:
        opened.configure(SETTINGS)
        opened.set_mode(Mode("BayerRG12p"))
        yield opened


def pattern(frame: Frame, block_id: int) -> np.ndarray:
    region = frame.settings.region
    return PatternSource()(Exposure(block_id, 0, 4000.0, 0, 12, region.x, region.y, region.columns, region.rows))


def check_whole(frames: list[Frame], whole: dict[int, int]) -> None:
    """That of these frames those at the keys are complete, with the pattern of the block at the value."""
    assert [i for i, frame in enumerate(frames) if frame.complete] == list(whole)
    for i, block_id in whole.items():
        np.testing.assert_array_equal(frames[i].data, pattern(frames[i], block_id))


# The control channel


@pytest.mark.parametrize(
    "faults",
    [
        Faults(pending_acks=3),
        Faults(stale_acks=5),
        Faults(lost_acks=2),
        Faults(late_acks=1),
        Faults(wrong_ack_ids=2),
        Faults(wrong_ack_commands=2),
        Faults(garbled_acks=2),
        Faults(short_acks=2),
        Faults(bad_statuses=2),
        Faults(control_halts=2),
        Faults(response_ms=150),
    ],
)
def test_passing_troubles_of_the_control_channel_are_overcome(
    camera: U3vCamera, device: VirtualCamera, faults: Faults
) -> None:
    device.inject(faults)
    assert camera.configure(Settings(2e-3, 1.0, REGION)) == Settings(2e-3, 1.0, REGION)
    check_whole(list(camera.frames(2)), {0: 0, 1: 1})


@pytest.mark.parametrize(
    ("faults", "expected"),
    [
        (Faults(lost_acks=FOREVER), CameraTimeout),
        (Faults(late_acks=FOREVER, late_ms=3000), CameraTimeout),
        (Faults(wrong_ack_ids=FOREVER), CameraTimeout),
        (Faults(wrong_ack_commands=FOREVER), CameraProtocolError),
        (Faults(garbled_acks=FOREVER), CameraProtocolError),
        (Faults(short_acks=FOREVER), CameraProtocolError),
        (Faults(bad_statuses=FOREVER), CameraError),
        (Faults(bad_statuses=FOREVER, status=Status.WRITE_PROTECT), CameraError),
        (Faults(bad_statuses=FOREVER, status=Status.ACCESS_DENIED), CameraError),
        (Faults(control_halts=FOREVER), CameraError),
        (Faults(unplug_at_command=0), CameraLost),
    ],
)
def test_lasting_troubles_of_the_control_channel_are_told(
    camera: U3vCamera, device: VirtualCamera, faults: Faults, expected: type
) -> None:
    device.inject(faults)
    with pytest.raises(expected, match=SENTENCE):
        camera.configure(Settings(2e-3, 1.0, REGION))
    if not device.plugged:
        return
    device.inject(Faults())
    assert camera.configure(Settings(3e-3, 1.0, REGION)).exposure_s == pytest.approx(3e-3)
    check_whole(list(camera.frames(2)), {0: 0, 1: 1})


def test_patience_has_an_end(camera: U3vCamera, device: VirtualCamera) -> None:
    device.inject(Faults(pending_acks=400))
    with pytest.raises(CameraTimeout, match="patience"):
        camera.configure(Settings(2e-3, 1.0, REGION))


def test_status_of_a_refusal_is_named(camera: U3vCamera, device: VirtualCamera) -> None:
    device.inject(Faults(bad_statuses=FOREVER, status=Status.INVALID_PARAMETER))
    with pytest.raises(CameraError, match="INVALID_PARAMETER"):
        camera.configure(Settings(2e-3, 1.0, REGION))


# Opening


@pytest.mark.parametrize("fault", [f for f in DescriptionFault if f not in (DescriptionFault.NONE, "uncompressed")])
def test_unsound_descriptions_are_refused_and_the_camera_is_left_free(fault: DescriptionFault) -> None:
    backend = VirtualBackend([VirtualCamera(faults=Faults(description=fault))])
    with pytest.raises(CameraError, match=SENTENCE):
        U3vCamera(backend=backend).__enter__()
    assert not backend._handles


def test_plain_descriptions_are_fine() -> None:
    device = VirtualCamera(faults=Faults(description=DescriptionFault.UNCOMPRESSED))
    with U3vCamera(backend=VirtualBackend([device])) as camera:
        assert len(list(camera.frames(1))) == 1


@pytest.mark.parametrize("faults", [Faults(access_denied=True), Faults(interface_busy=True)])
def test_a_camera_that_may_not_be_opened_is_busy(faults: Faults) -> None:
    backend = VirtualBackend([VirtualCamera(faults=faults)])
    with pytest.raises(CameraBusy, match=SENTENCE):
        U3vCamera(backend=backend).__enter__()
    assert not backend._handles


def test_a_camera_is_opened_by_one_alone(device: VirtualCamera) -> None:
    backend = VirtualBackend([device])
    with U3vCamera(backend=backend) as first:
        with pytest.raises(CameraBusy, match=SENTENCE):
            U3vCamera(backend=backend).__enter__()
        assert len(list(first.frames(2))) == 2


@pytest.mark.parametrize("command", [0, 1, 5, 20, 40])
def test_unplugged_while_it_is_opened(command: int) -> None:
    device = VirtualCamera(faults=Faults(unplug_at_command=command))
    backend = VirtualBackend([device])
    with pytest.raises(CameraLost, match=SENTENCE):
        U3vCamera(backend=backend).__enter__()
    assert not backend._handles


def test_a_camera_that_never_answers_is_given_up() -> None:
    backend = VirtualBackend([VirtualCamera(faults=Faults(lost_acks=FOREVER))])
    with pytest.raises(CameraTimeout, match=SENTENCE):
        U3vCamera(backend=backend).__enter__()
    assert not backend._handles


# The stream


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


@pytest.mark.parametrize("frame", [0, 3])
def test_unplugged_in_a_frame_and_plugged_in_again(frame: int) -> None:
    device = VirtualCamera()
    camera = U3vCamera(backend=VirtualBackend([device]))

    def take() -> int:
        taken = 0
        with camera:
            device.inject(Faults(unplug_at_frame=frame))
            for _ in camera.frames(10):
                taken += 1
        return taken

    with pytest.raises(CameraLost, match=SENTENCE):
        take()
    with pytest.raises(CameraLost, match="Plug it in"):
        camera.__enter__()
    device.plug()
    with camera:
        camera.configure(SETTINGS)
        camera.set_mode(Mode("BayerRG12p"))
        check_whole(list(camera.frames(2)), {0: 0, 1: 1})
        assert camera.counts == Counts(delivered=2)


def test_frames_before_the_unplugging_are_delivered(camera: U3vCamera, device: VirtualCamera) -> None:
    device.inject(Faults(unplug_at_frame=3))
    frames = camera.frames(10)
    check_whole([next(frames) for _ in range(3)], {0: 0, 1: 1, 2: 2})
    with pytest.raises(CameraLost):
        next(frames)


def test_unplugged_between_frames(camera: U3vCamera, device: VirtualCamera) -> None:
    list(camera.frames(1))
    device.unplug()
    for use in (lambda: next(camera.frames(1)), lambda: camera.configure(SETTINGS)):
        with pytest.raises(CameraLost, match=SENTENCE):
            use()


def test_another_camera_in_its_place_is_not_taken_for_it() -> None:
    device, other = VirtualCamera(), VirtualCamera(CameraModel(serial="OTHER"))
    other.unplug()
    camera = U3vCamera(backend=VirtualBackend([device, other]))
    with camera:
        pass
    device.unplug()
    other.plug()
    with pytest.raises(CameraLost, match="V0000001"):
        camera.__enter__()


def test_a_trigger_that_may_have_come_twice_gives_one_frame(camera: U3vCamera, device: VirtualCamera) -> None:
    camera.set_mode(Mode("BayerRG12p", None, Trigger.SOFTWARE))
    frames = camera.frames(3)
    next(frames)
    device.inject(Faults(lost_acks=1))
    next(frames)
    asked_s = device.clock.now_ns() / 1e9
    third = next(frames)
    assert third.timestamp_s >= asked_s


def test_a_run_that_could_not_be_stopped_does_not_hinder_the_next(camera: U3vCamera, device: VirtualCamera) -> None:
    frames = camera.frames(3)
    next(frames)
    device.inject(Faults(lost_acks=FOREVER, bad_statuses=FOREVER))  # refused, and not even told so
    next(frames)
    next(frames)
    with pytest.raises(CameraTimeout):
        next(frames)
    assert device._acquisition.running
    device.inject(Faults())
    check_whole(list(camera.frames(2)), {0: 0, 1: 1})


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


def test_a_failed_transfer_of_a_camera_that_is_gone_is_a_lost_camera(
    camera: U3vCamera, device: VirtualCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(self: VirtualBackend, *rest: object) -> int:
        device.unplug()
        raise usb.core.USBError("Input/output error", -1, errno.EIO)

    monkeypatch.setattr(VirtualBackend, "bulk_read", failing)
    with pytest.raises(CameraLost, match=SENTENCE):
        next(camera.frames(1))


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


def test_the_usb_device_is_left_free_when_genapi_fails(device: VirtualCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(self: NodeMap) -> None:
        raise CameraError("Expected an end, found none. Stop.")

    backend = VirtualBackend([device])
    camera = U3vCamera(backend=backend)
    camera.__enter__()
    assert backend._handles
    monkeypatch.setattr(NodeMap, "close", failing)
    with pytest.raises(CameraError, match="an end"):
        camera.__exit__(None, None, None)
    assert not backend._handles
