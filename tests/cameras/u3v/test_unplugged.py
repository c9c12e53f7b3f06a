"""Cameras that are unplugged while frames come."""

from __future__ import annotations

import errno

import pytest
import usb.core

from tests.cameras.u3v.small_frames import SENTENCE, SETTINGS, check_whole
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.model import CameraModel
from udccal.cameras.protocol import Counts, Mode
from udccal.cameras.u3v.camera import U3vCamera
from udccal.errors import CameraLost


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


def test_a_failed_transfer_of_a_camera_that_is_gone_is_a_lost_camera(
    camera: U3vCamera, device: VirtualCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(self: VirtualBackend, *rest: object) -> int:
        device.unplug()
        raise usb.core.USBError("Input/output error", -1, errno.EIO)

    monkeypatch.setattr(VirtualBackend, "bulk_read", failing)
    with pytest.raises(CameraLost, match=SENTENCE):
        next(camera.frames(1))
