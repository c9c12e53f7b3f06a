"""Troubles of the control channel."""

from __future__ import annotations

import pytest

from tests.cameras.u3v.small_frames import REGION, SENTENCE, check_whole
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.faults import FOREVER, Faults
from tests.virtual_u3v.memory import Status
from udccal.cameras.protocol import Mode, Settings, Trigger
from udccal.cameras.u3v.camera import U3vCamera
from udccal.errors import CameraError, CameraLost, CameraProtocolError, CameraTimeout


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
    with pytest.raises(CameraTimeout, match="more time"):
        camera.configure(Settings(2e-3, 1.0, REGION))


def test_status_of_a_refusal_is_named(camera: U3vCamera, device: VirtualCamera) -> None:
    device.inject(Faults(bad_statuses=FOREVER, status=Status.INVALID_PARAMETER))
    with pytest.raises(CameraError, match="INVALID_PARAMETER"):
        camera.configure(Settings(2e-3, 1.0, REGION))


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
