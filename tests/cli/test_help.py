"""Help of every verb is quick and loads nothing heavy."""

from __future__ import annotations

import re
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from click import Command
from typer.main import get_command

from udccal.cli.app import app
from udccal.cli.demo import demo


def _verbs(command: Command, words: list[str]) -> Iterator[list[str]]:
    """Every verb and group of verbs, so that none is forgotten."""
    yield words
    for name, verb in getattr(command, "commands", {}).items():
        yield from _verbs(verb, [*words, name])


VERBS = list(_verbs(get_command(app), []))
# typer itself loads pydantic, which is quick
HEAVY = ("jax", "numpy", "cv2", "matplotlib", "scipy", "equinox", "rawpy", "OpenEXR")
# An idle 2-core machine takes 0.5 s for the longest help and 0.3 s for the bare framework's; a slow one takes
# more for both, and so the one is measured against the other, in turns (1.7 to 2.2 times it, measured).
WORTH_OF_BARE_HELP = 3.0

PROBE = """
import sys
from udccal.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    assert not end.code, end.code
loaded = [name for name in {heavy!r} if name in sys.modules]
assert not loaded, loaded
"""

BARE = """
import typer
app = typer.Typer()
@app.command()
def bare(value: int = 1) -> None:
    "What the framework takes to say nothing."
app()
"""


@pytest.mark.parametrize("verb", VERBS, ids=lambda v: " ".join(v) or "udccal")
def test_help_is_quick_and_light(verb: list[str]) -> None:
    assert _times_the_bare_help(PROBE.format(heavy=HEAVY), verb) < WORTH_OF_BARE_HELP


@pytest.mark.medium
def test_a_slow_import_would_be_noticed() -> None:
    assert _times_the_bare_help("import jax\n" + PROBE.format(heavy=()), ["plan"]) > WORTH_OF_BARE_HELP


def _times_the_bare_help(code: str, verb: list[str]) -> float:
    """Least processor time of ``code`` run with ``verb --help`` over that of an empty command's help.

    Neighbours on the machine can only add to a run, and the least of several is the nearest to the truth: two pairs
    of runs, and up to three more while the ratio is above what is allowed.
    """
    ours, bare = [], []
    for pair in range(5):
        ours.append(_help_s(code, verb))
        bare.append(_help_s(BARE, []))
        if pair > 0 and min(ours) < WORTH_OF_BARE_HELP * min(bare):
            break
    return min(ours) / min(bare)


def _help_s(code: str, verb: list[str]) -> float:
    """Processor time of one run: what help takes on an idle machine, however busy this one is."""
    start = _children_s()
    done = subprocess.run([sys.executable, "-c", code, *verb, "--help"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "Usage" in done.stdout
    return _children_s() - start


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_a_heavy_import_would_be_noticed() -> None:
    code = "import numpy\n" + PROBE.format(heavy=HEAVY)
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True, timeout=60)
    assert done.returncode != 0
    assert "numpy" in done.stderr


def test_the_demonstrations_help_states_the_readmes_minutes() -> None:
    readme = (Path(__file__).resolve().parents[2] / "README.md").read_text(encoding="utf-8")
    stated = re.search(r"make demo +# .*: (.* minutes .*)", readme)
    assert stated is not None
    assert stated.group(1) in (demo.__doc__ or "")
