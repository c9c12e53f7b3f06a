"""Capture with a procedure of your own: the wire's flat from an integrating sphere, with fewer frames.

python examples/own_procedure.py SESSION        # on a simulated rig; docs/adding_a_procedure.md says how to install it
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import ClassVar, final

import udccal
from procedures.base import Procedure
from procedures.checks import is_dark, is_even
from procedures.plans import Metered, Stack, TimesThatOf
from procedures.step import Step, whole_sensor
from udccal.arrangements import Dark, FlatLight
from udccal.benches.bench import simulated_rig
from udccal.cameras.simulated import SimulatedCamera
from udccal.displays.simulated import SimulatedDisplay
from udccal.sessions.schema import TermName
from udccal.sessions.writer import SessionWriter


@final
class SphereWireProcedure(Procedure):
    """The wire term from an integrating sphere."""

    term: ClassVar[TermName] = "wire"

    def steps(self, rig: udccal.RigDescription) -> Iterator[Step]:
        """Yield the flat, then the dark at its exposure."""
        sphere = "Push the sphere's port against the display and close the curtain."
        yield Step("wire/flat", "wire", FlatLight(), sphere, is_even, whole_sensor(rig), Metered(0.65), Stack(8))
        cap = "Switch the sphere off and cap the lens."
        yield Step("wire/dark", "wire", Dark(), cap, is_dark, whole_sensor(rig), TimesThatOf("wire/flat"), Stack(4))


def main(path: str) -> None:
    rig = udccal.load_rig("lg55-reduced")
    rig = rig.model_copy(update={"camera": rig.camera.model_copy(update={"columns": 128, "rows": 96})})
    world = simulated_rig(rig, 0)
    camera, display = SimulatedCamera(world), SimulatedDisplay(world)
    with camera, display, SessionWriter.create(path, rig, camera.identity, world.now) as writer:
        SphereWireProcedure().run(camera, display, world, writer)
    for step in udccal.Session.open(path).steps("wire"):
        (average,) = step.captures
        print(f"{step.id}: {average.frames} frames of {1000 * average.exposure_s:.2f} ms")


if __name__ == "__main__":
    main(sys.argv[1])
