from __future__ import annotations

import numpy as np

from udccal.displays.mirrored import MirroredDisplay
from udccal.displays.protocol import Display
from udccal.displays.simulated import SimulatedDisplay
from udccal.rig import load_rig
from udccal.simulation.truth import draw_truth
from udccal.simulation.world import SimulatedWorld


def test_left_and_right_change_places_and_nothing_else() -> None:
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 64, "rows": 64})
    plain = SimulatedDisplay(SimulatedWorld(draw_truth(rig.model_copy(update={"camera": camera}))))
    picture = np.random.default_rng(0).integers(0, 256, (1080, 1920, 3)).astype(np.uint8)
    with MirroredDisplay(plain) as display:
        assert isinstance(display, Display)
        assert display.size == plain.size
        display.show(picture)
        np.testing.assert_array_equal(plain.picture, picture[:, ::-1])
        display.check()
        display.off()
        assert plain.picture is None
