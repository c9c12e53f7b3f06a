"""``udccal profile``: shows what a profile holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

profile_app = typer.Typer(help="Show what a profile holds.", no_args_is_help=True, pretty_exceptions_enable=False)


@profile_app.callback()
def profile() -> None:
    """Show what a profile holds."""


@profile_app.command(no_args_is_help=True)
def show(
    context: typer.Context,
    path: Annotated[Path, typer.Argument(metavar="PROFILE", help="The profile's folder or zip file, or a rig's name.")],
) -> None:
    """Show what a profile holds: every term's status, and every quantity with its unit and sigma."""
    from udccal.cli.jobs.show import show_profile

    show_profile(context.obj, path)
