"""Pictures of the steps of the noise term, as a person with any camera takes them."""

from __future__ import annotations

from pathlib import Path

from procedures.noise import NoiseProcedure
from procedures.plans import Fixed, Metered, Stack
from udccal.arrangements import Occasion
from udccal.benches.bench import simulated_rig
from udccal.cameras.protocol import Settings
from udccal.cameras.simulated import SimulatedCamera
from udccal.io.png import write_png16
from udccal.rig import RigDescription


def photograph_steps(rig: RigDescription, root: Path) -> None:
    """Write pictures of every step of the noise term, in a folder each with its ``frames.csv``."""
    world = simulated_rig(rig, seed=2)
    stack_s = 4.4e-3
    with SimulatedCamera(world) as camera:
        for number, step in enumerate(NoiseProcedure().steps(rig)):
            world.arrange(step.arrangement, Occasion(step.id, number, step.instruction))
            match step.exposure:
                case Metered():
                    exposure_s = stack_s
                case Fixed(exposure_s):
                    pass
                case other:
                    exposure_s = other.factor * stack_s
            camera.configure(Settings(max(exposure_s, rig.camera.min_exposure_s), 0.0, camera.sensor))
            folder = root / step.id
            folder.mkdir(parents=True)
            lines = ["file,exposure_s"]
            frames = step.plan.frames + (2 if isinstance(step.plan, Stack) else 1)
            for frame in camera.frames(frames):
                name = f"{frame.frame_id:06d}.png"
                write_png16(folder / name, frame.data)
                lines.append(f"{name},{frame.settings.exposure_s!r}")
            (folder / "frames.csv").write_text("\n".join(lines) + "\n")
