from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from udccal.cli.jobs.rigs import new_rig
from udccal.cli.output import Output
from udccal.compilation import FOLDER_VARIABLE, compilation_clock, compilation_folder
from udccal.errors import RigError
from udccal.rig_folders import find_rig, user_rig_folder

# Compiles something large and something small: both are worth keeping.
_PROGRAM = """
import jax, jax.numpy as jnp
from udccal.compilation import compilation_clock, keep_compilations
keep_compilations()
clock = compilation_clock()
def work(x):
    for k in range(150):
        x = jnp.sin(x @ x + k)
    return x
def little(x):
    return x + 1
jax.jit(work)(jnp.ones((8, 8))).block_until_ready()
jax.jit(little)(1.0).block_until_ready()
print(clock.seconds)
"""


def _run(folder: Path) -> float:
    environment = {**os.environ, FOLDER_VARIABLE: str(folder), "TF_CPP_MIN_LOG_LEVEL": "3"}
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    return float(done.stdout)


def _kept(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*-cache") if path.is_file()]


@pytest.mark.medium
def test_the_second_run_reads_what_the_first_compiled(tmp_path: Path) -> None:
    first = _run(tmp_path)
    kept = {path: path.stat().st_mtime_ns for path in _kept(tmp_path)}
    assert first > 0.1
    assert {"jit_work", "jit_little"} <= {path.name.split("-")[0] for path in kept}
    _run(tmp_path)
    assert kept == {path: path.stat().st_mtime_ns for path in _kept(tmp_path)}


@pytest.mark.medium
def test_a_folder_that_others_may_write_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    folder = compilation_folder()
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    _run(tmp_path)
    assert not _kept(tmp_path)


def test_processors_have_folders_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    here = compilation_folder()
    monkeypatch.setattr("udccal.compilation._processor", lambda: b"another one")
    assert compilation_folder() != here
    assert compilation_folder().parent == here.parent == tmp_path


def test_there_is_one_clock() -> None:
    assert compilation_clock() is compilation_clock()


@pytest.fixture
def no_home(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", absent)
    for name in (FOLDER_VARIABLE, "XDG_CACHE_HOME", "UDCCAL_RIGS"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.usefixtures("no_home")
def test_a_user_without_a_home_folder_names_another(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    monkeypatch.setenv("UDCCAL_RIGS", str(tmp_path / "rigs"))
    assert compilation_folder().parent == tmp_path
    assert user_rig_folder() == tmp_path / "rigs"


@pytest.mark.usefixtures("no_home")
def test_a_user_without_a_home_folder_has_the_shipped_rigs_and_a_cache() -> None:
    assert user_rig_folder() is None
    assert find_rig("lg55-reduced").is_dir()
    assert compilation_folder().is_relative_to(tempfile.gettempdir())
    with pytest.raises(RigError, match="UDCCAL_RIGS"):
        new_rig(Output(), "mine", "lg55-reduced")
