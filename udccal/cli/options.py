"""Options that several verbs share, said once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RigName = Annotated[str, typer.Option("--rig", help="Name of a shipped rig, of one of your own, or a folder.")]
SessionFolder = Annotated[Path, typer.Option("--session", help="Folder of the session; an unfinished one goes on.")]
ProfilePath = Annotated[Path, typer.Option("--profile", help="Folder of the profile, or its zip file.")]
FoundProfile = Annotated[Path, typer.Option("--profile", help="A profile's folder or zip file, or a rig's name.")]
OutFolder = Annotated[Path, typer.Option("--out", help="Folder for what is written.")]
Seed = Annotated[int, typer.Option("--seed", help="Which rig of that description is simulated, and with which noise.")]
IterationLog = Annotated[Path | None, typer.Option("--log", help="Write every iteration of every solver to this file.")]
PanelPicturePath = Annotated[
    Path | None, typer.Option("--panel-picture", help="8-bit RGB PNG that the panel showed; omit if not known.")
]
