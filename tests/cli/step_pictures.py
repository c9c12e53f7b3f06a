"""Pictures of the steps of a term, as a person with any camera takes them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from procedures.metering import meter
from procedures.noise import NoiseProcedure
from procedures.plans import Fixed, Metered, Stack
from procedures.step import Step
from udccal.arrangements import Occasion
from udccal.benches.bench import simulated_rig
from udccal.cameras.protocol import Settings
from udccal.cameras.simulated import SimulatedCamera
from udccal.io.png import write_png16
from udccal.rig import RigDescription

STACK_S = 4.4e-3


def photograph_steps(rig: RigDescription, root: Path, steps: Iterable[Step] | None = None) -> None:
    """Write pictures of steps, those of the noise term by default, in a folder each with its ``frames.csv``."""
    world = simulated_rig(rig, seed=2)
    with SimulatedCamera(world) as camera:
        for number, step in enumerate(NoiseProcedure().steps(rig) if steps is None else steps):
            world.arrange(step.arrangement, Occasion(step.id, number, step.instruction))
            folder = root / step.id
            folder.mkdir(parents=True)
            lines = ["file,exposure_s"]
            for exposure_s in _exposures_s(step, camera, rig):
                camera.configure(Settings(exposure_s, 0.0, camera.sensor))
                (frame,) = camera.frames(1)
                name = f"{frame.frame_id:06d}.png"
                write_png16(folder / name, frame.data)
                lines.append(f"{name},{frame.settings.exposure_s!r}")
            (folder / "frames.csv").write_text("\n".join(lines) + "\n")


def _exposures_s(step: Step, camera: SimulatedCamera, rig: RigDescription) -> tuple[float, ...]:
    """Return the exposure of every picture of a step, with some to spare for the checks before it."""
    match step.exposure:
        case Metered() if step.id == "noise/flat_stack":
            first_s = STACK_S
        case Metered():
            first_s = meter(camera, camera.sensor, step.exposure, rig).exposure_s
        case Fixed(first_s):
            pass
        case other:
            first_s = other.factor * STACK_S
    exposures_s = step.plan.exposures_s(max(first_s, rig.camera.min_exposure_s), rig.camera.max_exposure_s)
    return exposures_s[:1] * (2 if isinstance(step.plan, Stack) else 1) + exposures_s
