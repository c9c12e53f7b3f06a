"""The command ``udccal``: its verbs, its global options, and its error messages."""

from __future__ import annotations

import json
import os
import sys
import traceback
from typing import Annotated

import typer

from udccal import __version__
from udccal.cli.board import board
from udccal.cli.calibrate import calibrate
from udccal.cli.check import check
from udccal.cli.demo import demo
from udccal.cli.doctor import doctor
from udccal.cli.fit import fit
from udccal.cli.options import STOPPED
from udccal.cli.output import Output
from udccal.cli.plan import plan
from udccal.cli.profile import profile_app
from udccal.cli.restore import restore
from udccal.cli.rig import rig_app
from udccal.cli.run import run
from udccal.cli.simulate import simulate
from udccal.errors import UdccalError

_GLOBAL_FLAGS = ("--json", "--debug")
# The status that a shell gives to a program which ended by SIGPIPE.
_PIPE_CLOSED = 141

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


def main(arguments: list[str] | None = None) -> None:
    """Run the command and exit with its status, which docs/cli.md explains: 0, 1, 2, 3, 70, 130 or 141."""
    # Silences XLA's own log before JAX is imported: whatever matters in it also comes as an exception.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    given = list(sys.argv[1:] if arguments is None else arguments)
    flags = [flag for flag in _GLOBAL_FLAGS if flag in given]
    rest = [word for word in given if word not in _GLOBAL_FLAGS]
    try:
        app(args=[*flags, *rest], prog_name="udccal")
    except UdccalError as error:
        _fail(str(error), 1, flags)
    except SystemExit as left:  # typer and rich turn Ctrl-C and a closed pipe into this, without a word
        if left.code == STOPPED:
            sentence = "Stopped. Run the same command again to continue; completed steps of a session are kept."
            _fail(sentence, STOPPED, flags)
        if isinstance(left.__context__, BrokenPipeError):
            # What is still buffered goes nowhere; else Python would complain when it ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(_PIPE_CLOSED)
        raise
    except Exception as error:
        _fail(
            f"Something unexpected went wrong ({type(error).__name__}). "
            "Run the same command with --debug and report what it prints.",
            70,
            flags,
        )


def _fail(sentence: str, status: int, flags: list[str]) -> None:
    """Print one sentence on standard error, with ``--debug`` the traceback before it; exit with a non-zero status."""
    if "--debug" in flags:
        traceback.print_exc()
    if "--json" in flags:
        print(json.dumps({"error": sentence}), flush=True)
    print(f"udccal: {' '.join(sentence.split())}", file=sys.stderr, flush=True)
    sys.exit(status)


if __name__ == "__main__":
    main()
