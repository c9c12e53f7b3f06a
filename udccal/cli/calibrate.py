"""``udccal calibrate``: captures a session through the procedures, then fits it to a profile."""

from __future__ import annotations

import enum
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from udccal.cli.bench_options import (
    Agree,
    BenchOptions,
    Camera,
    CameraKind,
    Display,
    DisplayKind,
    Files,
    Monitor,
    Practice,
    Serial,
)
from udccal.cli.options import (
    DOUBTFUL,
    STOPPED,
    IterationLog,
    NoiseSeed,
    ProfilePath,
    RigName,
    Seed,
    SessionFolder,
    TermChoice,
)
from udccal.cli.output import Output

if TYPE_CHECKING:
    from udccal.guide.events import Person
    from udccal.rig import RigDescription


class ExchangedPart(enum.StrEnum):
    """A part of the rig that a person exchanged during a session."""

    camera = "camera"
    lens = "lens"


def calibrate(
    context: typer.Context,
    rig: RigName,
    session: SessionFolder,
    profile: ProfilePath,
    camera: Camera = CameraKind.sim,
    serial: Serial = None,
    files: Files = None,
    display: Display = DisplayKind.manual,
    monitor: Monitor = 0,
    seed: Seed = 0,
    noise_seed: NoiseSeed = None,
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
    practice: Practice = False,
    yes: Agree = False,
    json_events: Annotated[
        bool, typer.Option("--json-events", help="Write what happens on standard output, one JSON object a line.")
    ] = False,
    web: Annotated[bool, typer.Option("--web", help="Lead by a page in a browser; see docs/web.md.")] = False,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port of --web; 0 for any that is free.")] = 0,
    log: IterationLog = None,
) -> None:
    """Capture every calibration step of a rig, then fit them. An interrupted session continues where it stopped."""
    options = BenchOptions(camera, serial, files, display, monitor, seed, noise_seed, practice)
    options.check_words({"--yes": yes, "--json-events": json_events, "--web": web})
    if port and not web:
        raise typer.BadParameter("--port is for the page: give --web with it, or leave it out.")
    output: Output = replace(context.obj, events=json_events)
    from udccal.rig import load_rig

    description = load_rig(rig)
    # What is wrong with the words or the rig is told before the seconds that loading all else takes.
    from udccal.cli.jobs.apart import check_profile_place
    from udccal.cli.jobs.capture import Wanted
    from udccal.cli.jobs.fit import fit_to_profile
    from udccal.cli.jobs.log_file import check_log
    from udccal.io.out_folder import check_writable
    from udccal.sessions.changes import Exchanged

    check_profile_place(profile, session)
    check_log(log, session, profile)
    if log is not None:
        check_writable(log.parent)
    if session.resolve().is_relative_to(profile.resolve()):
        raise typer.BadParameter("The profile is replaced as a whole: give --session a folder that is not within it.")
    wanted = Wanted(
        session, [t.value for t in term or TermChoice], {Exchanged(part.value) for part in exchanged or ()}, again or ()
    )
    with _person(output, description, port if web else None) if options.led else nullcontext() as person:
        goes_on = options.capture(output, description, wanted, person, yes)
    if not goes_on:
        raise typer.Exit(STOPPED)
    if not fit_to_profile(output, session, profile, log):
        raise typer.Exit(DOUBTFUL)


def _person(output: Output, rig: RigDescription, port: int | None) -> AbstractContextManager[Person]:
    """A person before a page, or at the terminal where there is no port."""
    from udccal.cli.jobs.terminal import TerminalPerson
    from udccal.cli.jobs.web import web_person

    return nullcontext(TerminalPerson(output)) if port is None else web_person(output, rig, port)
