"""Options that several verbs share."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer


class TermChoice(enum.StrEnum):
    """A term that can be captured or fitted on its own."""

    noise = "noise"
    geometry = "geometry"
    wire = "wire"
    psf = "psf"
    backscatter = "backscatter"


# Exit status of a fit whose profile was written with a warning.
DOUBTFUL = 3
# Exit status of a comparison of profiles that have changed by more than is harmless, of a failed validation or check.
CHANGED = 3
# Exit status of a run that a person stopped, as shells give it to a program that ended by SIGINT.
STOPPED = 130

RigName = Annotated[str, typer.Option("--rig", help="Name of a shipped rig or of your own, or a folder.")]
SessionFolder = Annotated[Path, typer.Option("--session", help="Folder of the session; continues an unfinished one.")]
ProfilePath = Annotated[Path, typer.Option("--profile", help="Folder of the profile, or a zip file.")]
FoundProfile = Annotated[Path, typer.Option("--profile", help="A profile's folder or zip file, or a rig's name.")]
OutFolder = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
NoiseSeed = Annotated[
    int | None, typer.Option("--noise-seed", min=0, help="Noise of the simulated rig: the same rig, another day.")
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Chooses the specimen of the simulated rig, and its noise.")]
IterationLog = Annotated[Path | None, typer.Option("--log", help="Write every iteration of every solver to this file.")]
_PANEL_HELP = "8-bit RGB PNG that the panel showed, as seen from behind; omit if not known."
PanelPicturePath = Annotated[Path | None, typer.Option("--panel-picture", help=_PANEL_HELP)]
