"""``udccal profile``: what can be done with a profile."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.options import CHANGED, RigName
from udccal.tiers import Tier

profile_app = typer.Typer(
    help="Show, compare, validate, copy or prepare profiles, and exchange them with other programs.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


class ExportTo(enum.StrEnum):
    """A format that profiles are exported to."""

    opencv_yaml = "opencv-yaml"
    ros_camera_info = "ros-camera-info"
    mrcal = "mrcal"
    npz = "npz"
    csv = "csv"


class ImportFrom(enum.StrEnum):
    """A format that lenses are imported from."""

    opencv_yaml = "opencv-yaml"
    ros_camera_info = "ros-camera-info"
    mrcal = "mrcal"


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
    """Compute what restoration needs of a profile and keep it, so that the next restore starts quickly."""
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


@profile_app.command(no_args_is_help=True)
def export(
    context: typer.Context,
    path: ProfileArgument,
    to: Annotated[ExportTo, typer.Option("--to", help="The format; the covariance goes into a .json beside the file.")],
    out: Annotated[Path, typer.Option("--out", help="The new file.")],
) -> None:
    """Write a profile's numbers for another program, and say what its format cannot hold."""
    from udccal.cli.jobs.exchange import export

    export(context.obj, path, to.value, out)


@profile_app.command("import", no_args_is_help=True)
def import_(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Another program's calibration of the camera.")],
    of: Annotated[ImportFrom, typer.Option("--from", help="The format of the file.")],
    rig: RigName,
    out: Annotated[Path, typer.Option("--out", help="Folder of the profile to write, or a zip file.")],
) -> None:
    """Make a profile with the lens of another program's calibration; the other terms stay nominal."""
    from udccal.cli.jobs.exchange import import_

    import_(context.obj, of.value, file, rig, out)


@profile_app.command(no_args_is_help=True)
def validate(
    context: typer.Context,
    session: Annotated[Path, typer.Option("--session", help="Folder of a session of the same rig, best a later one.")],
    path: Annotated[
        Path | None, typer.Argument(metavar="[PROFILE]", help="The profile's folder or zip file, or a rig's name.")
    ] = None,
    against: Annotated[
        Path | None, typer.Option("--against", help="Instead of a profile: folder of another session of the rig.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Write validation.json and validation.html to this folder.")
    ] = None,
) -> None:
    """Say whether a profile predicts a session that it was not fitted to, with a map for each term.

    With --against instead of a profile: say whether two sessions show the same rig, by what both captured alike.
    """
    from udccal.cli.jobs import validate as job

    if path is not None and against is None:
        ok = job.validate_profile(context.obj, path, session, out)
    elif path is None and against is not None:
        ok = job.validate_session(context.obj, session, against, out)
    else:
        raise typer.BadParameter("Expected a profile or --against with another session, and not both.")
    if not ok:
        raise typer.Exit(CHANGED)
