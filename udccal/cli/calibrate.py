"""``udccal calibrate``: captures a session through the procedures, then fits it to a profile."""

from __future__ import annotations

import enum
from typing import Annotated

import typer

from udccal.cli.options import ProfilePath, RigName, Seed, SessionFolder


class CameraKind(enum.StrEnum):
    """Which camera captures."""

    sim = "sim"


class TermChoice(enum.StrEnum):
    """A term that can be captured on its own."""

    noise = "noise"
    geometry = "geometry"
    wire = "wire"
    psf = "psf"
    backscatter = "backscatter"


def calibrate(
    context: typer.Context,
    rig: RigName,
    session: SessionFolder,
    profile: ProfilePath,
    camera: Annotated[CameraKind, typer.Option("--camera", help="sim: a simulated rig.")] = CameraKind.sim,
    seed: Seed = 0,
    term: Annotated[
        list[TermChoice] | None, typer.Option("--term", help="Capture this term only; may be given again.")
    ] = None,
) -> None:
    """Capture every calibration step of a rig, then fit them. An interrupted session goes on where it stopped."""
    from udccal.cli.jobs.capture import capture, simulated_rig
    from udccal.cli.jobs.fit import fit_to_profile
    from udccal.profiles.store import check_replaceable
    from udccal.rig import load_rig

    description = load_rig(rig)
    check_replaceable(profile)
    capture(context.obj, description, simulated_rig(description, seed), session, [t.value for t in term or TermChoice])
    fit_to_profile(context.obj, session, profile)
