"""``udccal profile``: what can be done with a profile."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.options import CHANGED
from udccal.tiers import Tier

profile_app = typer.Typer(
    help="Show, compare, copy or prepare profiles, and exchange them with other programs.",
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
def log(
    context: typer.Context,
    path: ProfileArgument,
) -> None:
    """Tell a profile's past: when, with what and from which session it was made, and what it was derived from."""
    from udccal.cli.jobs.log import log_profile

    log_profile(context.obj, path)


@profile_app.command(no_args_is_help=True)
def pack(
    context: typer.Context,
    path: ProfileArgument,
    file: Annotated[Path, typer.Argument(metavar="FILE.zip", help="The zip file to write.")],
) -> None:
    """Write a profile as one zip file, byte for byte."""
    from udccal.cli.jobs import copies

    copies.pack(context.obj, path, file)


@profile_app.command(no_args_is_help=True)
def unpack(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="FILE.zip", help="A profile's zip file.")],
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder to write.")],
) -> None:
    """Write the profile of a zip file as a folder, byte for byte."""
    from udccal.cli.jobs import copies

    copies.unpack(context.obj, file, folder)


@profile_app.command(no_args_is_help=True)
def migrate(
    context: typer.Context,
    path: ProfileArgument,
    out: Annotated[Path, typer.Option("--out", help="Folder to write, or a zip file.")],
) -> None:
    """Write a profile of an older format version anew in the present one; the old one becomes its parent."""
    from udccal.cli.jobs import copies

    copies.migrate(context.obj, path, out)
