"""``udccal calibrate``: captures a session through the procedures, then fits it to a profile."""

from __future__ import annotations

import enum
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from udccal.cli.options import DOUBTFUL, IterationLog, ProfilePath, RigName, Seed, SessionFolder, TermChoice
from udccal.cli.output import Output
from udccal.errors import CameraError

if TYPE_CHECKING:
    from udccal.benches.bench import CaptureBench
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


CAMERA_HELP = "sim: a simulated rig; u3v: any USB3 Vision camera; pylon: through Basler's SDK; files: see --files."
DISPLAY_HELP = "For a real rig. window: full screen on --monitor; manual: you show the named files."
Serial = Annotated[str | None, typer.Option("--serial", help="Serial number; needed if there are several.")]
Files = Annotated[Path | None, typer.Option("--files", help="Folder with one folder of pictures per step.")]
Monitor = Annotated[int, typer.Option("--monitor", help="Number of the monitor that is the panel; see doctor.")]


def calibrate(
    context: typer.Context,
    rig: RigName,
    session: SessionFolder,
    profile: ProfilePath,
    camera: Annotated[CameraKind, typer.Option("--camera", help=CAMERA_HELP)] = CameraKind.sim,
    serial: Serial = None,
    files: Files = None,
    display: Annotated[DisplayKind, typer.Option("--display", help=DISPLAY_HELP)] = DisplayKind.manual,
    monitor: Monitor = 0,
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
    log: IterationLog = None,
) -> None:
    """Capture every calibration step of a rig, then fit them. An interrupted session continues where it stopped."""
    from udccal.cli.jobs.capture import capture_watched
    from udccal.cli.jobs.fit import fit_to_profile
    from udccal.io.out_folder import check_writable
    from udccal.profiles.store import check_replaceable
    from udccal.rig import load_rig
    from udccal.sessions.changes import Exchanged

    output: Output = context.obj
    description = load_rig(rig)
    check_replaceable(profile)
    check_writable(profile.parent)
    options = BenchOptions(camera, serial, files, display, monitor, seed)
    with options.opened(output, description, session) as bench:
        parts = {Exchanged(part.value) for part in exchanged or ()}
        capture_watched(output, bench, session, [t.value for t in term or TermChoice], parts, again or ())
    if not fit_to_profile(output, session, profile, log):
        raise typer.Exit(DOUBTFUL)


@dataclass(frozen=True)
class BenchOptions:
    """Where a rig is: simulated, at this computer, or in files; the options of the verbs that capture."""

    camera: CameraKind
    serial: str | None
    files: Path | None
    display: DisplayKind
    monitor: int
    seed: int
    noise_seed: int | None = None

    def opened(self, output: Output, rig: RigDescription, session: Path) -> AbstractContextManager[CaptureBench]:
        """Open the bench for a session; the panel's pictures go next to it."""
        pictures = session.resolve().with_name(f"{session.resolve().name}-pictures")
        match self.camera:
            case CameraKind.sim:
                return _simulated(rig, self.seed, self.noise_seed)
            case CameraKind.files:
                return _files(output, rig, self.files, pictures)
            case _:
                return _real(output, rig, self.camera, self.serial, self.display, self.monitor, pictures)


def _simulated(rig: RigDescription, seed: int, noise_seed: int | None) -> AbstractContextManager[CaptureBench]:
    from udccal.benches.bench import simulated_bench, simulated_rig

    return simulated_bench(simulated_rig(rig, seed, noise_seed))


def _files(
    output: Output, rig: RigDescription, files: Path | None, pictures: Path
) -> AbstractContextManager[CaptureBench]:
    from udccal.cli.jobs.benches import files_bench

    if files is None:
        raise CameraError("Expected the folder with the pictures of each step, found none. Give it with --files.")
    return files_bench(output, rig, files, pictures)


def _real(
    output: Output,
    rig: RigDescription,
    camera: CameraKind,
    serial: str | None,
    display: DisplayKind,
    monitor: int,
    pictures: Path,
) -> AbstractContextManager[CaptureBench]:
    from udccal.cli.jobs import benches

    seen = benches.u3v_camera(serial) if camera is CameraKind.u3v else benches.pylon_camera(serial)
    if display is DisplayKind.window:
        shown = benches.window_display(rig, monitor)
    else:
        shown = benches.manual_display(output, rig, pictures)
    return benches.real_bench(output, rig, seen, shown)
