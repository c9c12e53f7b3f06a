"""Procedures, and the runner that carries out their steps on a real or simulated bench."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar, final

from procedures.set_up import set_ups
from procedures.step import Bench, Step, exposure_of, run_step
from udccal.arrangements import Stage
from udccal.cameras.choice import check_camera
from udccal.cameras.protocol import Camera
from udccal.displays.protocol import Display
from udccal.guide.steps import GuidedStep
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName
from udccal.sessions.writer import SessionWriter


@dataclass(frozen=True)
class StepProgress:
    """Progress before each step, and once more (``step`` None) when all are done."""

    term: TermName
    done: int
    total: int
    step: Step | None


Progress = Callable[[StepProgress], None]


class Procedure(ABC):
    """The captures of one term."""

    term: ClassVar[TermName]

    @abstractmethod
    def steps(self, rig: RigDescription) -> Iterator[Step]:
        """Yield the steps in their order, one at a time."""

    def guided(self, rig: RigDescription) -> Iterator[GuidedStep]:
        """Yield what a person is led through: one set-up for steps in a row that have the same instruction."""
        yield from set_ups(rig, self.steps)

    @final
    def run(
        self, camera: Camera, display: Display, stage: Stage, writer: SessionWriter, progress: Progress | None = None
    ) -> None:
        """Carry out the steps as ``run_procedure`` does, for callers that have a procedure by entry point only."""
        run_procedure(self, Bench(camera, display, stage), writer, progress)


def run_procedure(procedure: Procedure, bench: Bench, writer: SessionWriter, progress: Progress | None = None) -> None:
    """Carry out every step that the session does not hold yet, on a bench whose camera is open.

    Raises:
        CaptureError: when the camera does not see what a step needs: a person at the rig can mend that and repeat it.
        CameraError: when the camera does not fit the rig; also from the camera itself.
        SessionError: from the writer. Steps completed before stay in the session.
    """
    rig = writer.manifest.rig
    check_camera(bench.camera, rig)
    total = sum(1 for _ in procedure.steps(rig))
    before: str | None = None
    for done, step in enumerate(procedure.steps(rig)):
        if progress is not None:
            progress(StepProgress(procedure.term, done, total, step))
        if step.id not in writer.completed_ids:
            run_step(step, bench, writer, exposure_of(before, writer), procedure.steps(rig))
        before = step.id
    if progress is not None:
        progress(StepProgress(procedure.term, total, total, None))
