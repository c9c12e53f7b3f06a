"""``udccal check``: a few minutes at the rig say whether its profile still holds, and what changed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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
from udccal.cli.options import CHANGED, STOPPED, FoundProfile, NoiseSeed, Seed


def check(
    context: typer.Context,
    profile: FoundProfile,
    camera: Camera = CameraKind.sim,
    serial: Serial = None,
    files: Files = None,
    display: Display = DisplayKind.manual,
    monitor: Monitor = 0,
    seed: Seed = 0,
    noise_seed: NoiseSeed = None,
    practice: Practice = False,
    yes: Agree = False,
    out: Annotated[Path, typer.Option("--out", help="Folder for the captures, check.json and check.html.")] = Path(
        "udccal-check"
    ),
    update: Annotated[
        Path | None, typer.Option("--update", help="Write the profile with what changed solved for again.")
    ] = None,
) -> None:
    """Check a rig against its profile: ten flats, twenty dark frames and three panel pictures, in three minutes."""
    options = BenchOptions(camera, serial, files, display, monitor, seed, noise_seed, practice)
    options.check_words({"--yes": yes})
    from udccal.cli.jobs.check import check_profile

    same = check_profile(context.obj, profile, options, yes, out, update)
    if not same:
        raise typer.Exit(STOPPED if same is None else CHANGED)
