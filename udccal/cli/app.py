"""The verbs of ``udccal`` and its global options."""

from __future__ import annotations

from typing import Annotated

import typer

from udccal import __version__
from udccal.cli.board import board
from udccal.cli.calibrate import calibrate
from udccal.cli.check import check
from udccal.cli.demo import demo
from udccal.cli.doctor import doctor
from udccal.cli.fit import fit
from udccal.cli.output import Output
from udccal.cli.plan import plan
from udccal.cli.profile import profile_app
from udccal.cli.restore import restore
from udccal.cli.rig import rig_app
from udccal.cli.run import run
from udccal.cli.simulate import simulate

app = typer.Typer(
    name="udccal",
    help="Calibrate a camera that looks through a transparent display, and restore what it sees.",
    epilog="--json and --debug may also stand after the verb.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"udccal {__version__}")
        raise typer.Exit


@app.callback()
def globals_(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Calibrate a camera that looks through a transparent display, and restore what it sees."""
    context.obj = Output(as_json=as_json, debug=debug)


for _verb in (demo, doctor, board, plan, calibrate, fit, check, restore, run, simulate):
    app.command(no_args_is_help=_verb not in (demo, doctor))(_verb)
app.add_typer(profile_app, name="profile")
app.add_typer(rig_app, name="rig")
