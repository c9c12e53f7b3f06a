"""A simulated bench at toy size for the tests of procedures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from procedures.base import Bench
from tests.simulation.toy import toy_rig
from udccal.cameras.simulated import SimulatedCamera
from udccal.displays.simulated import SimulatedDisplay
from udccal.rig import RigDescription
from udccal.sessions.writer import SessionWriter
from udccal.simulation.disturbances import Disturbances
from udccal.simulation.truth import draw_truth
from udccal.simulation.world import SimulatedWorld


def small_rig() -> RigDescription:
    rig = toy_rig()
    few = {
        "flats": 12,
        "noise_levels": 4,
        "noise_stack": 3,
        "psf_columns": 2,
        "psf_rows": 1,
        "psf_shifts": 2,
        "psf_exposures": 3,
        "psf_region_columns": 24,
        "psf_region_rows": 32,
        "backscatter_pictures": 3,
        "backscatter_frames": 2,
    }
    return rig.model_copy(update={"captures": rig.captures.model_copy(update=few)})


@contextmanager
def simulated_bench(rig: RigDescription, disturbances: Disturbances | None = None) -> Iterator[Bench]:
    world = SimulatedWorld(draw_truth(rig, 1), disturbances)
    with SimulatedCamera(world) as camera:
        yield Bench(camera, SimulatedDisplay(world), world)


def new_writer(folder: Path, rig: RigDescription, bench: Bench) -> SessionWriter:
    return SessionWriter.create(folder, rig, bench.camera.identity)
