"""Help of every verb is quick and loads nothing heavy."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest

VERBS = (
    [],
    ["demo"],
    ["doctor"],
    ["calibrate"],
    ["fit"],
    ["plan"],
    ["restore"],
    ["simulate"],
    ["profile"],
    ["profile", "show"],
)
# typer itself loads pydantic, which is quick
HEAVY = ("jax", "numpy", "cv2", "matplotlib", "scipy", "equinox", "rawpy", "OpenEXR")
LIMIT_S = 0.5

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


def run_help(verb: list[str]) -> subprocess.CompletedProcess[str]:
    code = PROBE.format(heavy=HEAVY)
    return subprocess.run([sys.executable, "-c", code, *verb, "--help"], capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("verb", VERBS, ids=lambda v: " ".join(v) or "udccal")
def test_help_is_quick_and_light(verb: list[str]) -> None:
    seconds = []
    for _ in range(5):
        start = _children_s()
        done = run_help(verb)
        seconds.append(_children_s() - start)
        assert done.returncode == 0, done.stderr
        assert "Usage" in done.stdout
    # Neighbours on the machine can only add to it: the least of the runs is the nearest to the truth.
    assert min(seconds) < LIMIT_S


def _children_s() -> float:
    """Processor time of finished children: what help takes on an idle machine, however busy this one is."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_a_heavy_import_would_be_noticed() -> None:
    code = "import numpy\n" + PROBE.format(heavy=HEAVY)
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True, timeout=60)
    assert done.returncode != 0
    assert "numpy" in done.stderr
