"""``udccal profile``: shows what a profile holds, compares two, validates one, and prepares restoration with one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.options import CHANGED
from udccal.tiers import Tier

profile_app = typer.Typer(
    help="Show what a profile holds, compare two, validate one, or prepare one.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
ProfileArgument = Annotated[
    Path, typer.Argument(metavar="PROFILE", help="The profile's folder or zip file, or a rig's name.")
]


@profile_app.command(no_args_is_help=True)
def show(
    context: typer.Context,
    path: ProfileArgument,
) -> None:
    """Show what a profile holds: every term's status, and every quantity with its unit and sigma."""
    from udccal.cli.jobs.show import show_profile

    show_profile(context.obj, path)


@profile_app.command(no_args_is_help=True)
def prepare(
    context: typer.Context,
    path: ProfileArgument,
    tier: Annotated[Tier, typer.Option("--tier", help="How much restoration does to a frame.")] = Tier.balanced,
) -> None:
    """Compute what restoration needs of a profile and keep it, so that the next ``udccal restore`` starts quickly."""
    from udccal.cli.jobs.prepare import prepare_profile

    prepare_profile(context.obj, path, tier)


@profile_app.command(no_args_is_help=True)
def diff(
    context: typer.Context,
    a: Annotated[Path, typer.Argument(metavar="A", help="A profile's folder or zip file, or a rig's name.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Another profile of the same rig.")],
    out: Annotated[Path | None, typer.Option("--out", help="Write diff.json and diff.html to this folder.")] = None,
) -> None:
    """Say whether two profiles of one rig differ, by how much, whether it matters, and how the camera moved."""
    from udccal.cli.jobs.diff import diff_profiles

    if not diff_profiles(context.obj, a, b, out):
        raise typer.Exit(CHANGED)


@profile_app.command(no_args_is_help=True)
def validate(
    context: typer.Context,
    path: ProfileArgument,
    session: Annotated[Path, typer.Option("--session", help="Folder of a session of the same rig, best a later one.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Write validation.json and validation.html to this folder.")
    ] = None,
) -> None:
    """Say whether a profile predicts a session that it was not fitted to, with a map for each term."""
    from udccal.cli.jobs.validate import validate_profile

    if not validate_profile(context.obj, path, session, out):
        raise typer.Exit(CHANGED)
