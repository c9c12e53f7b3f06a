"""A simulated world with an even light and a sensor small enough for tests."""

from __future__ import annotations

from udccal.arrangements import FlatLight
from udccal.rig import load_rig
from udccal.simulation.disturbances import Disturbances
from udccal.simulation.truth import RigTruth, draw_truth
from udccal.simulation.world import SimulatedWorld


def toy_truth() -> RigTruth:
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 128, "rows": 96, "cfa": "GBRG"})
    return draw_truth(rig.model_copy(update={"camera": camera}))


def flat_world(disturbances: Disturbances | None = None, seed: int = 0) -> SimulatedWorld:
    world = SimulatedWorld(toy_truth(), disturbances, seed)
    world.arrange(FlatLight())
    return world
