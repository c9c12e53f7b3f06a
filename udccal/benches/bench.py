"""What a capture works with: a camera, a display, and whoever puts things in front of the camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

from udccal.arrangements import Stage
from udccal.cameras.protocol import Camera
from udccal.cameras.simulated import SimulatedCamera
from udccal.displays.protocol import Display
from udccal.displays.simulated import SimulatedDisplay
from udccal.rig import RigDescription
from udccal.sessions.writer import Now
from udccal.simulation.truth import draw_truth
from udccal.simulation.world import SimulatedWorld


@dataclass(frozen=True)
class CaptureBench:
    """A rig with its camera open and its display on.

    Attributes:
        rig: as it was built to be.
        camera, display: open.
        stage: whoever puts things in front of the camera.
        now: time of day there.
        try_again: asked with the sentence of a refused step, whether to repeat the step.
    """

    rig: RigDescription
    camera: Camera
    display: Display
    stage: Stage
    now: Now
    try_again: Callable[[str], bool]


def simulated_rig(rig: RigDescription, seed: int) -> SimulatedWorld:
    """A simulated rig of that description; another seed is another specimen, and other noise."""
    return SimulatedWorld(draw_truth(rig, seed), seed=seed)


@contextmanager
def simulated_bench(world: SimulatedWorld) -> Iterator[CaptureBench]:
    """Camera, display, stage and clock of a simulated world, where nothing gets better by trying again."""
    with SimulatedCamera(world) as camera, SimulatedDisplay(world) as display:
        yield CaptureBench(world.truth.description, camera, display, world, world.now, lambda sentence: False)


def simulate(rig: RigDescription, seed: int = 0) -> AbstractContextManager[CaptureBench]:
    """A simulated rig to capture with: ``with simulate(rig) as bench``.

    Args:
        rig: as it was built to be; the simulated one differs from it within its tolerances.
        seed: of the specimen and its noise.
    """
    return simulated_bench(simulated_rig(rig, seed))
