"""Fixtures of the driver's tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.cameras.u3v.small_frames import SETTINGS
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from udccal.cameras.protocol import Mode
from udccal.cameras.u3v.camera import U3vCamera


@pytest.fixture
def device() -> VirtualCamera:
    return VirtualCamera()


@pytest.fixture
def camera(device: VirtualCamera) -> Iterator[U3vCamera]:
    """Opened, with small frames."""
    with U3vCamera(backend=VirtualBackend([device])) as opened:
        opened.configure(SETTINGS)
        opened.set_mode(Mode("BayerRG12p"))
        yield opened
