"""What the driver's tests share."""

from __future__ import annotations

import pytest

from tests.virtual_u3v.camera import VirtualCamera


@pytest.fixture
def device() -> VirtualCamera:
    return VirtualCamera()
