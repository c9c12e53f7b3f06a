"""Cameras that cannot be opened, or not be closed."""

from __future__ import annotations

import pytest

from tests.cameras.u3v.small_frames import SENTENCE
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.faults import FOREVER, DescriptionFault, Faults
from udccal.cameras.u3v.camera import U3vCamera
from udccal.cameras.u3v.nodes import NodeMap
from udccal.errors import CameraBusy, CameraError, CameraLost, CameraTimeout


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
