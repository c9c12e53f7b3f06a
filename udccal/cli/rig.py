"""``udccal rig``: lists rigs, begins a description of one, and checks it."""

from __future__ import annotations

from typing import Annotated

import typer

rig_app = typer.Typer(
    help="List, begin or check rig descriptions.", no_args_is_help=True, pretty_exceptions_enable=False
)


@rig_app.command("list")
def list_(context: typer.Context) -> None:
    """List your own rigs and those that ship with udccal."""
    from udccal.cli.jobs.rigs import list_rigs

    list_rigs(context.obj)


@rig_app.command(no_args_is_help=True)
def new(
    context: typer.Context,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Lower-case letters, digits, dot, dash, underscore.")],
    like: Annotated[str, typer.Option("--like", help="Rig whose description is copied.")] = "lg55-aca2040",
) -> None:
    """Begin a rig of your own: a copy of another one's rig.toml, for you to edit."""
    from udccal.cli.jobs.rigs import new_rig

    new_rig(context.obj, name, like)


@rig_app.command(no_args_is_help=True)
def check(
    context: typer.Context,
    rig: Annotated[str, typer.Argument(metavar="NAME", help="Name of a rig, or a folder.")],
) -> None:
    """Check a rig's description, and show what follows from it: a wrong unit shows there."""
    from udccal.cli.jobs.rigs import check_rig

    check_rig(context.obj, rig)
