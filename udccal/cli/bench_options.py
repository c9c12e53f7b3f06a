"""Where a rig is, for the verbs that capture: their common options, and how a session is captured there."""

from __future__ import annotations

import enum
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, final

import typer

from udccal.cli.output import Output
from udccal.errors import CameraError

if TYPE_CHECKING:
    from udccal.cli.jobs.capture import Wanted
    from udccal.guide.events import Person
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


_CAMERA_HELP = "sim: a simulated rig; u3v: any USB3 Vision camera; pylon: through Basler's SDK; files: see --files."
_DISPLAY_HELP = "For a real rig. window: full screen on --monitor; manual: you show the named files."
Camera = Annotated[CameraKind, typer.Option("--camera", help=_CAMERA_HELP)]
Serial = Annotated[str | None, typer.Option("--serial", help="Serial number; needed if there are several.")]
Files = Annotated[Path | None, typer.Option("--files", help="Folder with one folder of pictures per step.")]
Display = Annotated[DisplayKind, typer.Option("--display", help=_DISPLAY_HELP)]
Monitor = Annotated[int, typer.Option("--monitor", help="Number of the monitor that is the panel; see doctor.")]
Practice = Annotated[
    bool, typer.Option("--practice", help="With --camera sim: you lead a simulated hand, which may do wrong.")
]
Agree = Annotated[bool, typer.Option("--yes", help="Go on by itself wherever all is in order.")]


@final
@dataclass(frozen=True)
class BenchOptions:
    """Where a rig is: simulated, at this computer, or in files.

    Attributes:
        camera: the backend.
        serial: of a real camera; None for the only one.
        files: folder with one folder of pictures per step, for ``CameraKind.files``.
        display, monitor: how a real panel shows pictures.
        seed, noise_seed: specimen and noise of a simulated rig; noise as the specimen where there is no seed for it.
        practice: whether a person leads a simulated hand at the simulated rig.
    """

    camera: CameraKind
    serial: str | None
    files: Path | None
    display: DisplayKind
    monitor: int
    seed: int
    noise_seed: int | None = None
    practice: bool = False

    @property
    def real(self) -> bool:
        """Whether a person has to set things up before the camera."""
        return self.camera in (CameraKind.u3v, CameraKind.pylon)

    @property
    def led(self) -> bool:
        """Whether a person is led through the capture."""
        return self.practice or self.real

    def check_words(self, for_led: Mapping[str, bool]) -> None:
        """Refuse options that do not go together.

        Args:
            for_led: whether each option was given that is for a person who is led, by its name.

        Raises:
            typer.BadParameter: with the options that do not go together.
        """
        if self.practice and self.camera is not CameraKind.sim:
            raise typer.BadParameter("--practice is for the simulated rig: give --camera sim with it, or leave it out.")
        if any(for_led.values()) and not self.led:
            *most, last = for_led
            names = f"{', '.join(most)} and {last} are" if most else f"{last} is"
            raise typer.BadParameter(f"{names} for --camera u3v or pylon, and for --practice.")
        for name, given, right, cameras in self._of_some_cameras():
            if given and not right:
                raise typer.BadParameter(
                    f"{name} is for --camera {cameras}, found {self.camera}. Leave one of them out."
                )

    def _of_some_cameras(self) -> Iterator[tuple[str, bool, bool, str]]:
        """Options that only some cameras have: name, whether it was given, whether this camera has it, and which do."""
        simulated = self.camera is CameraKind.sim
        shown = self.display is not DisplayKind.manual
        yield "--files", self.files is not None, self.camera is CameraKind.files, "files"
        yield "--serial", self.serial is not None, self.real, "u3v or pylon"
        yield "--display", shown, self.real, "u3v or pylon"
        yield "--monitor", self.monitor != 0, self.real, "u3v or pylon"
        yield "--seed", self.seed != 0, simulated, "sim"
        yield "--noise-seed", self.noise_seed is not None, simulated, "sim"

    def capture(self, output: Output, rig: RigDescription, wanted: Wanted, person: Person | None, agree: bool) -> bool:
        """Capture a session; return False when the person has stopped it.

        Args:
            output: shows stages and messages.
            rig: the rig, with the captures that are wanted.
            wanted: session, terms and steps.
            person: who is led at a real rig, or at a simulated one for practice; None where nobody is.
            agree: whether it goes on by itself wherever all is in order.

        Raises:
            CameraError: when the camera cannot be opened or does not fit the rig.
            UdccalError: as ``udccal.benches.capture.capture`` does.
        """
        if person is None:
            self._watched(output, rig, wanted)
            return True
        return self._led(output, rig, wanted, person, agree)

    def _watched(self, output: Output, rig: RigDescription, wanted: Wanted) -> None:
        from udccal.benches.bench import simulate
        from udccal.cli.jobs.benches import files_bench
        from udccal.cli.jobs.capture import capture_watched

        if self.camera is CameraKind.sim:
            opened = simulate(rig, self.seed, self.noise_seed)
        elif self.files is None:
            raise CameraError("Expected the folder with the pictures of each step, found none. Give it with --files.")
        else:
            opened = files_bench(output, rig, self.files, wanted.pictures)
        with opened as bench:
            capture_watched(output, bench, wanted)

    def _led(self, output: Output, rig: RigDescription, wanted: Wanted, person: Person, agree: bool) -> bool:
        from udccal.cli.jobs import benches, guided

        led = guided.led_by(output, person, agree)
        if self.camera is CameraKind.sim:
            with guided.practice_bench(rig, self.seed, self.noise_seed, led) as (bench, practising):
                return not guided.capture_led(output, bench, practising, wanted).stopped
        find = benches.u3v_camera if self.camera is CameraKind.u3v else benches.pylon_camera
        seen = find(self.serial)
        if self.display is DisplayKind.window:
            shown = benches.window_display(rig, self.monitor)
        else:
            # No frame tells whether a picture is on the panel, so that nobody but the person can say that it is.
            shown = benches.manual_display(rig, wanted.pictures, guided.led_by(output, person, agree=False))
        with benches.real_bench(rig, seen, shown) as bench:
            return not guided.capture_led(output, bench, led, wanted).stopped
