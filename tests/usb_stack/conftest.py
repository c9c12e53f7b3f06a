"""Cameras at the ports of a real USB stack.

Where the kernel has none, the tests are skipped and say so; where one was promised, they fail.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.usb_stack.needs import PROMISED, lacking
from tests.usb_stack.vhci import CONTROLLER, Plug, PlugIn
from tests.virtual_u3v.camera import VirtualCamera


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Function]) -> None:
    """In the guest, whose processor is slow, only what needs its kernel is run."""
    if os.environ.get(PROMISED):
        others = [item for item in items if "plug_in" not in item.fixturenames]
        config.hook.pytest_deselected(items=others)
        items[:] = [item for item in items if item not in others]


@pytest.fixture
def plug_in() -> Iterator[PlugIn]:
    """Puts cameras into ports, and pulls at the end whatever is still plugged in."""
    if not (CONTROLLER / "attach").exists():
        lacking("needs the kernel module vhci_hcd and root: run 'make test-usb', which boots a kernel that has it")
    plugs: list[tuple[VirtualCamera, Plug]] = []

    def put(camera: VirtualCamera) -> Plug:
        camera.plug()
        plugs.append((camera, Plug(camera)))
        return plugs[-1][1]

    yield put
    for camera, plug in plugs:
        if camera.plugged:
            plug.pull()
