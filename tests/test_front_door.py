"""What ``import udccal`` gives: quickly, lazily, and all of it there."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import udccal
from tests.toy_rigs import write_toy_rig
from udccal.result import FitResult, FitStatus

# Of the processor, so that a busy machine fails nobody.
_TRIES, _MOST_S = 5, 0.2
_TIMED = "import time; start = time.process_time(); {}; print(time.process_time() - start)"


def _seconds(statement: str) -> float:
    command = [sys.executable, "-c", _TIMED.format(statement)]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def test_importing_udccal_takes_no_time() -> None:
    assert min(_seconds("import udccal") for _ in range(_TRIES)) < _MOST_S < _seconds("import jax")


def test_importing_udccal_loads_no_heavy_package() -> None:
    code = "import sys, udccal; print(sorted({'jax', 'cv2', 'scipy', 'numpy', 'pydantic'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize("name", udccal.__all__)
def test_every_name_is_there_and_documented(name: str) -> None:
    assert getattr(udccal, name).__doc__


def test_a_whole_programs_verbs_are_there() -> None:
    verbs = {"load_rig", "simulate", "capture", "fit", "load_profile", "save_profile", "diff", "restore"}
    assert verbs <= set(udccal.__all__)


def test_results_are_compared_by_what_they_are() -> None:
    """They hold arrays, which have no single answer to ``==``: it ended in numpy's traceback."""
    one, other = (FitResult.failed("noise", np.ones(2), FitStatus.TOO_DARK, "no light") for _ in range(2))
    assert one == one
    assert one != other
    assert len({one, other, one}) == 2
    kinds = [getattr(udccal, name) for name in udccal.__all__]
    holding = [kind for kind in kinds if isinstance(kind, type) and is_dataclass(kind)]
    assert len(holding) > 5
    assert all(kind.__eq__ is object.__eq__ for kind in holding)


def test_an_unknown_name_is_answered_with_those_there_are() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'calibrat'; it has .*calibrate"):
        udccal.calibrat  # noqa: B018


def test_a_term_that_is_none_is_refused() -> None:
    with pytest.raises(udccal.UdccalError, match="one of noise, geometry, wire, psf, backscatter, found 'wires'"):
        udccal.fit(object.__new__(udccal.Session), "wires")


def test_a_result_of_a_term_that_is_none_is_refused() -> None:
    profile = udccal.load_profile("lg55-reduced")
    assert profile.result("wire") is profile.wire
    with pytest.raises(udccal.UdccalError, match="one of noise, geometry, wire, psf, backscatter, found 'wires'"):
        profile.result("wires")


@pytest.mark.usefixtures("as_other_programs_call")
@pytest.mark.parametrize("seeds", [{"seed": "a"}, {"seed": None}, {"noise_seed": -1}])
def test_a_seed_that_is_none_is_refused(tmp_path: Path, seeds: dict[str, Any]) -> None:
    with pytest.raises(udccal.UdccalError, match="Expected a seed as a whole number from 0 to"):
        udccal.simulate(udccal.load_rig(write_toy_rig(tmp_path)), **seeds)


def test_a_capture_takes_names_of_terms_alone_and_leaves_no_session_for_others(tmp_path: Path) -> None:
    with udccal.simulate(udccal.load_rig(write_toy_rig(tmp_path))) as bench:
        for terms in (["noise", "wires"], "wires"):
            with pytest.raises(udccal.UdccalError, match=r"of noise, .*, backscatter, found 'wires'"):
                udccal.capture(tmp_path / "session", bench, terms)
        assert not (tmp_path / "session").exists()
        assert udccal.capture(tmp_path / "session", bench, "noise").steps("noise")


_REFUSALS = """
import inspect, udccal
for name in {names}:
    function = getattr(udccal, name)
    needed = [one for one in inspect.signature(function).parameters.values() if one.default is one.empty]
    for given in (None, 3, "session", [[1.0, 2.0]]):
        try:
            function(*[given] * len(needed))
            print(name, given, "was accepted")
        except udccal.UdccalError as error:
            if "found" not in str(error):
                print(name, given, error)
"""


def test_what_is_of_another_kind_is_refused_in_a_sentence(tmp_path: Path) -> None:
    """Paths for sessions and profiles are what people try first. A process of its own has no check of types."""
    names = ["calibrate", "capture", "compare_sessions", "deblur", "diff", "fit", "load_profile", "load_rig"]
    names += ["restore", "save_profile", "simulate", "validate"]
    names += [f"fit_{term}" for term in ("backscatter", "geometry", "noise", "psf", "wire")]
    command = [sys.executable, "-c", _REFUSALS.format(names=names)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert (done.returncode, done.stdout, done.stderr[-2000:]) == (0, "", "")
    assert not list(tmp_path.iterdir())
