"""One step of a procedure, and how it is carried out on a real or simulated bench."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from procedures.capture import take
from procedures.checks import Check, NotDarkError, frame_limits, refuse_far_exposure, usual_exposure_s
from procedures.metering import Exposed, meter, trial_frame
from procedures.plans import Exposure, Fixed, Metered, Plan, TimesThatOf
from udccal.arrangements import Arrangement, Board, Dark, FlatLight, Led, Occasion, PanelPicture, Stage
from udccal.cameras.files import FILES
from udccal.cameras.protocol import Camera, Region
from udccal.displays.protocol import Display
from udccal.errors import CaptureError, SessionError, UdccalError
from udccal.rig import RigDescription
from udccal.sessions.captured import Capture, SingleFrame
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
        instruction: what a person must do, as a sentence. Steps with the same one are set up once.
        role: role of the picture on the panel, for steps that show one.
        title: a few words for what is set up.
        why: one sentence: what the step is good for.
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
    title: str = ""
    why: str = ""


@dataclass(frozen=True)
class Bench:
    """What a procedure works with."""

    camera: Camera
    display: Display
    stage: Stage


def exposure_of(step_id: str | None, writer: SessionWriter) -> float | None:
    """Return a step's exposure as a guess for the next; it comes from the session, so that resuming changes nothing."""
    step = writer.step(step_id) if step_id is not None else None
    return None if step is None else step.captures[0].exposure_s


def set_up(step: Step, bench: Bench, writer: SessionWriter) -> None:
    """Have the panel and the stage show what a step needs."""
    if isinstance(step.arrangement, PanelPicture):
        bench.display.show(step.arrangement.picture)
    else:
        bench.display.off()
    bench.stage.arrange(step.arrangement, Occasion(step.id, writer.number(step.id), step.instruction))


def take_step(step: Step, bench: Bench, writer: SessionWriter, start_s: float | None) -> tuple[Capture, ...]:
    """Set a step up, find its exposure, check what the camera sees and take the frames; the session stays as it is.

    Raises:
        CaptureError: when the camera does not see what the step needs.
        SessionError: when the exposure follows from a step that was not captured.
    """
    rig = writer.manifest.rig
    set_up(step, bench, writer)
    try:
        exposed = _expose(step, bench.camera, writer, start_s)
        step.check(exposed.frame, rig)
        limits = frame_limits(rig, exposed.exposure_s, dark=isinstance(step.arrangement, Dark))
        captures = take(bench.camera, step.region, exposed.exposure_s, step.plan, limits, rig.camera.max_exposure_s)
        bench.display.check()
    except CaptureError as error:
        raise type(error)(f"Step {step.id}: {error}") from error
    return captures


def run_step(
    step: Step, bench: Bench, writer: SessionWriter, start_s: float | None, steps: Iterable[Step] = ()
) -> None:
    """Carry a step out and add it to the session; it raises as ``take_step`` does.

    Args:
        step: the step.
        bench: camera, display and stage.
        writer: gets the step.
        start_s: first guess of an exposure that is metered.
        steps: those of the procedure: where the step was captured before, at another exposure, those whose exposure
            followed from it leave the session, and so do those that a dark step has found to be in the light.
    """
    try:
        captures = take_step(step, bench, writer, start_s)
    except NotDarkError:
        _leave_out_lit(step, writer, steps)
        raise
    writer.add_step(
        step.id, step.term, _subject(step, writer), captures, _stale(step.id, _first_s(captures), writer, steps)
    )


def _leave_out_lit(dark: Step, writer: SessionWriter, steps: Iterable[Step]) -> None:
    """Leave out the panel's pictures of a blackout whose dark step has found light: it was in them, too.

    Those stay that an earlier run has captured together with a dark step.
    """
    alike = {one.id: one.arrangement for one in steps if one.instruction == dark.instruction}
    pictures = {step_id for step_id, one in alike.items() if isinstance(one, PanelPicture)}
    if pictures and (writer.step(dark.id) is None or pictures & writer.added):
        writer.drop(alike)


def _first_s(captures: Sequence[Capture]) -> float:
    first = captures[0]
    return (first.frame if isinstance(first, SingleFrame) else first).settings.exposure_s


def _stale(step_id: str, exposure_s: float, writer: SessionWriter, steps: Iterable[Step]) -> tuple[str, ...]:
    """Return the steps that were captured at an exposure which followed from this one's, and no longer does."""
    before = exposure_of(step_id, writer)
    if before is None or abs(exposure_s / before - 1) < _SAME_EXPOSURE:
        return ()
    return tuple(
        step.id for step in steps if isinstance(step.exposure, TimesThatOf) and step.exposure.step_id == step_id
    )


def _expose(step: Step, camera: Camera, writer: SessionWriter, start_s: float | None) -> Exposed:
    rig = writer.manifest.rig
    match step.exposure:
        case Metered() if step.id in writer.again:
            return _metered(step, step.exposure, camera, writer, exposure_of(step.id, writer))
        case Metered(signal="even") if (captured := writer.step(step.id)) is not None:
            # Its files are damaged but its exposure is known: other steps were captured at the same one.
            wanted = captured.captures[0].exposure_s
        case Metered():
            return _metered(step, step.exposure, camera, writer, start_s)
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


def _metered(step: Step, plan: Metered, camera: Camera, writer: SessionWriter, start_s: float | None) -> Exposed:
    exposed = meter(camera, step.region, plan, writer.manifest.rig, start_s)
    if camera.identity.backend == FILES:  # the exposure is what somebody wrote; a camera's own is what it did
        alike = (other for other in writer.manifest.steps if other.term == step.term and other.id != step.id)
        first = next(alike, None) if isinstance(step.arrangement, Led | Board) else None
        usual_s = usual_exposure_s(step.arrangement) if first is None else first.captures[0].exposure_s
        refuse_far_exposure(exposed.exposure_s, usual_s)
    return exposed


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


def whole_sensor(rig: RigDescription) -> Region:
    """Return the whole sensor as a region."""
    return Region(0, 0, rig.camera.columns, rig.camera.rows)
