"""Procedures, their steps, and the runner that carries them out on a real or simulated bench."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal, final

from procedures.capture import take
from procedures.checks import Check, frame_limits, refuse_far_exposure
from procedures.metering import Exposed, meter, trial_frame
from procedures.plans import Exposure, Fixed, Metered, Plan, TimesThatOf
from udccal.arrangements import Arrangement, Board, Dark, FlatLight, Led, Occasion, PanelPicture, Stage
from udccal.cameras.protocol import Camera, Region
from udccal.displays.protocol import Display
from udccal.errors import CameraError, CaptureError, SessionError, UdccalError
from udccal.rig import RigDescription
from udccal.sessions.schema import BoardSubject, DarkSubject, FlatSubject, LedSubject, Subject, TermName
from udccal.sessions.writer import SessionWriter

# Relative difference of two exposures of which one was to be the other's.
_SAME_EXPOSURE = 0.01
PictureRole = Literal["white", "picture", "brightened"]


@dataclass(frozen=True)
class Step:
    """One thing to set up, check and capture.

    Attributes:
        id: ``term/name``, unique in a session.
        instruction: what a person must do, as a sentence.
        role: role of the picture on the panel, for steps that show one.
    """

    id: str
    term: TermName
    arrangement: Arrangement
    instruction: str
    check: Check
    region: Region
    exposure: Exposure
    plan: Plan
    role: PictureRole = "picture"


@dataclass(frozen=True)
class Bench:
    """What a procedure works with."""

    camera: Camera
    display: Display
    stage: Stage


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
    _check_camera(bench.camera, rig)
    total = sum(1 for _ in procedure.steps(rig))
    before: str | None = None
    for done, step in enumerate(procedure.steps(rig)):
        if progress is not None:
            progress(StepProgress(procedure.term, done, total, step))
        if step.id not in writer.completed_ids:
            _run_step(step, bench, writer, _exposure_of(before, writer), partial(procedure.steps, rig))
        before = step.id
    if progress is not None:
        progress(StepProgress(procedure.term, total, total, None))


def _exposure_of(step_id: str | None, writer: SessionWriter) -> float | None:
    """Return a step's exposure as a guess for the next; it comes from the session, so that resuming changes nothing."""
    step = writer.step(step_id) if step_id is not None else None
    return None if step is None else step.captures[0].exposure_s


def _run_step(
    step: Step, bench: Bench, writer: SessionWriter, start_s: float | None, steps: Callable[[], Iterator[Step]]
) -> None:
    rig = writer.manifest.rig
    arrangement = step.arrangement
    if isinstance(arrangement, PanelPicture):
        bench.display.show(arrangement.picture)
    else:
        bench.display.off()
    bench.stage.arrange(arrangement, Occasion(step.id, writer.number(step.id), step.instruction))
    try:
        exposed = _expose(step, bench.camera, writer, start_s)
        step.check(exposed.frame, rig)
        limits = frame_limits(rig, exposed.exposure_s, dark=isinstance(arrangement, Dark))
        captures = take(bench.camera, step.region, exposed.exposure_s, step.plan, limits, rig.camera.max_exposure_s)
        bench.display.check()
    except CaptureError as error:
        raise CaptureError(f"Step {step.id}: {error}") from error
    stale = _stale(step.id, exposed.exposure_s, writer, steps)
    writer.add_step(step.id, step.term, _subject(step, writer), captures, stale)


def _stale(
    step_id: str, exposure_s: float, writer: SessionWriter, steps: Callable[[], Iterator[Step]]
) -> tuple[str, ...]:
    """Return the steps that were captured at an exposure which followed from this one's, and no longer does."""
    before = _exposure_of(step_id, writer)
    if before is None or abs(exposure_s / before - 1) < _SAME_EXPOSURE:
        return ()
    return tuple(
        step.id for step in steps() if isinstance(step.exposure, TimesThatOf) and step.exposure.step_id == step_id
    )


def _expose(step: Step, camera: Camera, writer: SessionWriter, start_s: float | None) -> Exposed:
    rig = writer.manifest.rig
    match step.exposure:
        case Metered() if step.id in writer.again:
            return meter(camera, step.region, step.exposure, rig, _exposure_of(step.id, writer))
        case Metered(signal="even") if (captured := writer.step(step.id)) is not None:
            # Its files are damaged but its exposure is known: other steps were captured at the same one.
            wanted = captured.captures[0].exposure_s
        case Metered():
            return meter(camera, step.region, step.exposure, rig, start_s)
        case Fixed(exposure_s):
            wanted = exposure_s
        case TimesThatOf(step_id, factor):
            earlier = writer.step(step_id)
            if earlier is None:
                raise SessionError(f"Expected the step '{step_id}' before this one, found it not captured. Capture it.")
            wanted = factor * earlier.captures[0].exposure_s
    bounded = min(max(wanted, rig.camera.min_exposure_s), rig.camera.max_exposure_s)
    frame = trial_frame(camera, step.region, bounded)
    refuse_far_exposure(frame.settings.exposure_s, bounded)
    return Exposed(frame.settings.exposure_s, frame)


def _subject(step: Step, writer: SessionWriter) -> Subject:
    match step.arrangement:
        case Dark():
            return DarkSubject()
        case FlatLight():
            return FlatSubject()
        case Led(x_px, y_px, distance_mm, diameter_mm):
            return LedSubject(x_px=x_px, y_px=y_px, distance_mm=distance_mm, diameter_mm=diameter_mm)
        case Board(spec, parallel_to_panel=parallel):
            return BoardSubject(
                columns=spec.columns,
                rows=spec.rows,
                square_mm=spec.square_mm,
                marker_mm=spec.marker_mm,
                dictionary=spec.dictionary,
                parallel_to_panel=parallel,
            )
        case PanelPicture(picture):
            return writer.store_picture(step.id, picture, step.role)
    raise UdccalError(f"Expected an arrangement that calibrates a term, found another for the step '{step.id}'.")


def _check_camera(camera: Camera, rig: RigDescription) -> None:
    expected = (rig.camera.columns, rig.camera.rows, rig.camera.cfa, rig.camera.bits)
    found = (camera.sensor.columns, camera.sensor.rows, camera.cfa, camera.bits)
    if found != expected:
        raise CameraError(
            f"Expected a camera of {expected[0]} x {expected[1]}, {expected[2]}, {expected[3]} bits as in the rig "
            f"'{rig.name}', found {found[0]} x {found[1]}, {found[2]}, {found[3]} bits. "
            "Connect the right camera, or correct rig.toml."
        )


def whole_sensor(rig: RigDescription) -> Region:
    """Return the whole sensor as a region."""
    return Region(0, 0, rig.camera.columns, rig.camera.rows)
