"""``udccal calibrate``: captures a session through the procedures, then fits it to a profile."""

from __future__ import annotations

import enum
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from udccal.cli.options import DOUBTFUL, STOPPED, IterationLog, ProfilePath, RigName, Seed, SessionFolder, TermChoice
from udccal.cli.output import Output
from udccal.errors import CameraError

if TYPE_CHECKING:
    from udccal.cli.jobs.capture import Wanted
    from udccal.guide.events import DoneEvent, Person
    from udccal.rig import RigDescription


class CameraKind(enum.StrEnum):
    """Which camera captures."""

    sim = "sim"
    u3v = "u3v"
    pylon = "pylon"
    files = "files"


class DisplayKind(enum.StrEnum):
    """How pictures are shown on the panel of a real rig."""

    window = "window"
    manual = "manual"


class ExchangedPart(enum.StrEnum):
    """A part of the rig that a person exchanged during a session."""

    camera = "camera"
    lens = "lens"


_CAMERA_HELP = "sim: a simulated rig; u3v: any USB3 Vision camera; pylon: through Basler's SDK; files: see --files."
_DISPLAY_HELP = "For a real rig. window: full screen on --monitor; manual: you show the named files."


def calibrate(
    context: typer.Context,
    rig: RigName,
    session: SessionFolder,
    profile: ProfilePath,
    camera: Annotated[CameraKind, typer.Option("--camera", help=_CAMERA_HELP)] = CameraKind.sim,
    serial: Annotated[str | None, typer.Option("--serial", help="Serial number; needed if there are several.")] = None,
    files: Annotated[Path | None, typer.Option("--files", help="Folder with one folder of pictures per step.")] = None,
    display: Annotated[DisplayKind, typer.Option("--display", help=_DISPLAY_HELP)] = DisplayKind.manual,
    monitor: Annotated[int, typer.Option("--monitor", help="Number of the monitor that is the panel; see doctor.")] = 0,
    seed: Seed = 0,
    term: Annotated[
        list[TermChoice] | None, typer.Option("--term", help="Capture this term only; may be given again.")
    ] = None,
    exchanged: Annotated[
        list[ExchangedPart] | None, typer.Option("--exchanged", help="Part that was exchanged since the session began.")
    ] = None,
    again: Annotated[
        list[str] | None,
        typer.Option("--again", metavar="STEP", help="Capture this captured step once more; may be given again."),
    ] = None,
    practice: Annotated[
        bool, typer.Option("--practice", help="With --camera sim: you lead a simulated hand, which may do wrong.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Go on by itself wherever all is in order.")] = False,
    json_events: Annotated[
        bool, typer.Option("--json-events", help="Write what happens on standard output, one JSON object a line.")
    ] = False,
    web: Annotated[bool, typer.Option("--web", help="Lead by a page in a browser; see docs/web.md.")] = False,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port of --web; 0 for any that is free.")] = 0,
    log: IterationLog = None,
) -> None:
    """Capture every calibration step of a rig, then fit them. An interrupted session continues where it stopped."""
    from udccal.cli.jobs.capture import Wanted
    from udccal.cli.jobs.fit import fit_to_profile
    from udccal.cli.jobs.guided import led_by
    from udccal.io.out_folder import check_writable
    from udccal.profiles.store import check_replaceable
    from udccal.rig import load_rig
    from udccal.sessions.changes import Exchanged

    led = practice or camera in (CameraKind.u3v, CameraKind.pylon)
    _check_words(camera, led, practice, yes or json_events or web)
    if port and not web:
        raise typer.BadParameter("--port is for the page: give --web with it, or leave it out.")
    output: Output = replace(context.obj, events=json_events)
    description = load_rig(rig)
    check_replaceable(profile)
    check_writable(profile.parent)
    wanted = Wanted(
        session, [t.value for t in term or TermChoice], {Exchanged(part.value) for part in exchanged or ()}, again or ()
    )
    if not led:
        _capture(output, description, wanted, camera, files, seed)
    else:
        with _person(output, description, port if web else None) as person:
            source = Source(camera, serial, display, monitor, seed)
            done = _lead(output, description, wanted, source, led_by(output, person, yes))
        if done.stopped:
            raise typer.Exit(STOPPED)
    if not fit_to_profile(output, session, profile, log):
        raise typer.Exit(DOUBTFUL)


@dataclass(frozen=True)
class Source:
    """Where the frames of a guided capture come from, and how the panel is operated."""

    camera: CameraKind
    serial: str | None
    display: DisplayKind
    monitor: int
    seed: int


def _check_words(camera: CameraKind, led: bool, practice: bool, of_led: bool) -> None:
    if practice and camera is not CameraKind.sim:
        raise typer.BadParameter("--practice is for the simulated rig: give --camera sim with it, or leave it out.")
    if of_led and not led:
        raise typer.BadParameter("--yes, --json-events and --web are for --camera u3v or pylon, and for --practice.")


def _capture(
    output: Output, rig: RigDescription, wanted: Wanted, camera: CameraKind, files: Path | None, seed: int
) -> None:
    """Capture with nobody at the rig: a simulated one, or pictures of files."""
    from udccal.benches.bench import simulate
    from udccal.cli.jobs.benches import files_bench
    from udccal.cli.jobs.capture import capture_watched

    if camera is CameraKind.sim:
        opened = simulate(rig, seed)
    elif files is None:
        raise CameraError("Expected the folder with the pictures of each step, found none. Give it with --files.")
    else:
        opened = files_bench(output, rig, files, wanted.pictures)
    with opened as bench:
        capture_watched(output, bench, wanted)


def _person(output: Output, rig: RigDescription, port: int | None) -> AbstractContextManager[Person]:
    """A person before a page, or at the terminal where there is no port."""
    from udccal.cli.jobs.terminal import TerminalPerson
    from udccal.cli.jobs.web import web_person

    return nullcontext(TerminalPerson(output)) if port is None else web_person(output, rig, port)


def _lead(output: Output, rig: RigDescription, wanted: Wanted, source: Source, person: Person) -> DoneEvent:
    """Capture with a person who is led, at a real rig or at a simulated one."""
    from udccal.cli.jobs import benches, guided

    if source.camera is CameraKind.sim:
        with guided.practice_bench(rig, source.seed, person) as (bench, practising):
            return guided.capture_led(output, bench, practising, wanted)
    find = benches.u3v_camera if source.camera is CameraKind.u3v else benches.pylon_camera
    seen = find(source.serial)
    if source.display is DisplayKind.window:
        shown = benches.window_display(rig, source.monitor)
    else:
        shown = benches.manual_display(rig, wanted.pictures, person)
    with benches.real_bench(rig, seen, shown) as bench:
        return guided.capture_led(output, bench, person, wanted)
