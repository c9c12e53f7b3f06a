"""Benches: a camera, a display, and the stage that puts things in front of the camera."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

from udccal.arguments import check_kind, check_seed
from udccal.arrangements import Stage
from udccal.cameras.protocol import Camera
from udccal.cameras.simulated import SimulatedCamera
from udccal.displays.protocol import Display
from udccal.displays.simulated import SimulatedDisplay
from udccal.errors import RigError
from udccal.rig import RigDescription
from udccal.sessions.writer import Now
from udccal.simulation.truth import draw_truth
from udccal.simulation.world import SimulatedWorld


@dataclass(frozen=True)
class CaptureBench:
    """A rig with its camera open and its display on.

    Attributes:
        rig: the rig's description.
        camera, display: open.
        stage: puts things in front of the camera.
        now: returns the bench's time of day.
    """

    rig: RigDescription
    camera: Camera
    display: Display
    stage: Stage
    now: Now


def simulated_rig(rig: RigDescription, seed: int, noise_seed: int | None = None) -> SimulatedWorld:
    """Return a simulated rig with the description ``rig``.

    Another ``seed`` gives another specimen and other noise. Another ``noise_seed`` gives the same specimen on another
    day; it is ``seed`` where there is none.
    """
    return SimulatedWorld(draw_truth(rig, seed), seed=seed if noise_seed is None else noise_seed)


@contextmanager
def simulated_bench(world: SimulatedWorld) -> Iterator[CaptureBench]:
    """Open camera, display, stage and clock of ``world``."""
    with SimulatedCamera(world) as camera, SimulatedDisplay(world) as display:
        yield CaptureBench(world.truth.description, camera, display, world, world.now)


def simulate(rig: RigDescription, seed: int = 0, noise_seed: int | None = None) -> AbstractContextManager[CaptureBench]:
    """Simulate a rig to capture with: ``with simulate(rig) as bench``.

    Args:
        rig: description; the simulated rig differs from it within its tolerances.
        seed: chooses the specimen and its noise.
        noise_seed: chooses the noise alone: the same rig on another day.

    Returns:
        a context that opens the bench: camera, display, stage and clock. Simulated exposures take no real time.
    """
    check_kind(rig, RigDescription, "Read one by udccal.load_rig(name).", RigError)
    check_seed(seed, RigError)
    if noise_seed is not None:
        check_seed(noise_seed, RigError)
    return simulated_bench(simulated_rig(rig, seed, noise_seed))
