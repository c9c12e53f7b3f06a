from __future__ import annotations

import numpy as np
import pytest

from udccal.cameras.protocol import Region
from udccal.displays.protocol import Display, PanelSize
from udccal.displays.simulated import SimulatedDisplay
from udccal.errors import DisplayError
from udccal.rig import load_rig
from udccal.simulation.truth import draw_truth
from udccal.simulation.world import SimulatedWorld

WHOLE = Region(0, 0, 64, 64)


@pytest.fixture
def world() -> SimulatedWorld:
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 64, "rows": 64})
    return SimulatedWorld(draw_truth(rig.model_copy(update={"camera": camera})))


def test_shows_and_goes_off(world: SimulatedWorld) -> None:
    display = SimulatedDisplay(world)
    assert isinstance(display, Display)
    assert display.size == PanelSize(1920, 1080)
    white = np.full((1080, 1920, 3), 255, np.uint8)
    with display:
        display.show(white)
        display.check()
    assert (world.expected_rate(WHOLE) > 1e3).all()
    white[:] = 0
    assert display.picture is not None
    assert display.picture.min() == 255
    display.off()
    assert display.picture is None
    assert not world.expected_rate(WHOLE).any()


def test_refuses_a_picture_of_another_size(world: SimulatedWorld) -> None:
    with pytest.raises(DisplayError, match="1920 x 1080"):
        SimulatedDisplay(world).show(np.zeros((108, 192, 3), np.uint8))
