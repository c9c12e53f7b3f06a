from __future__ import annotations

import zipfile
from pathlib import Path
from unittest.mock import MagicMock

import pytest
import typer

from udccal.cameras.protocol import CameraIdentity
from udccal.cli.calibrate import calibrate
from udccal.cli.jobs.fit import _iterations_to, fit_to_profile
from udccal.cli.output import Output
from udccal.errors import UdccalError
from udccal.fitting.engine.least_squares import LOG
from udccal.rig import load_rig
from udccal.sessions.writer import SessionWriter


def test_iterations_are_not_written_through_a_link(tmp_path: Path) -> None:
    SessionWriter.create(tmp_path / "session", load_rig("lg55-reduced"), CameraIdentity("a", "b", "c", "d")).close()
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "session" / "fit.log").symlink_to(tmp_path / "mine")
    with pytest.raises(UdccalError, match=r"fit\.log is a link; remove it"):
        fit_to_profile(Output(), tmp_path / "session", tmp_path / "profile", tmp_path / "session" / "fit.log")
    assert (tmp_path / "mine").read_text() == "mine"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a file that is always full")
def test_fits_go_on_where_their_log_cannot(capsys: pytest.CaptureFixture[str]) -> None:
    with _iterations_to(Output(), Path("/dev/full")):
        LOG.debug("a line")
        LOG.debug("another")
    assert capsys.readouterr().err == "The iterations in /dev/full are cut short: it could not be written to.\n"
    assert not LOG.handlers


def test_iterations_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with _iterations_to(Output(), tmp_path / "fit.log"):
        LOG.debug("a line")
    assert (tmp_path / "fit.log").read_text().endswith(" ms  a line\n")
    assert capsys.readouterr().err == ""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a session, and a profile as its file names tell it."""
    SessionWriter.create(tmp_path / "session", load_rig("lg55-reduced"), CameraIdentity("a", "b", "c", "d")).close()
    for name in ("session/noise/0.png", "other/profile.json", "other/wire.exr"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    (tmp_path / "link").symlink_to(tmp_path / "other")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.write(tmp_path / "other" / "profile.json", "profile.json")
    return tmp_path


def contents(folder: Path) -> dict[Path, bytes]:
    return {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}


REFUSED = {
    "session/session.json": "inside the session",
    "session/noise/0.png": "inside the session",
    "session/new.log": "inside the session",
    "other/profile.json": "inside the profile",
    "other/new.log": "inside the profile",
    "link/wire.exr": "inside the profile",
    "other.zip": "a zip file, as profiles are",
    "profile/new.log": "apart from .*profile, which this command needs",
}


@pytest.mark.parametrize("log", REFUSED)
def test_a_log_among_the_files_of_a_session_or_a_profile_is_refused(
    folder: Path, log: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("udccal.cli.jobs.fit.keep_compilations", lambda: pytest.fail("worked"))
    before = contents(folder)
    with pytest.raises(UdccalError, match=REFUSED[log]):
        fit_to_profile(Output(), folder / "session", folder / "profile", folder / log)
    assert contents(folder) == before


def test_calibrate_refuses_such_a_log_before_it_captures(folder: Path) -> None:
    context = MagicMock(spec=typer.Context, obj=Output())
    before = contents(folder)
    for log, words in (("session/session.json", "inside the session"), ("new/log", "apart from .*new, which")):
        with pytest.raises(UdccalError, match=words):
            calibrate(context, "lg55-reduced", folder / "new", folder / "profile", log=folder / log)
    assert contents(folder) == before


def test_a_log_is_left_alone_until_there_is_something_to_write(tmp_path: Path) -> None:
    (tmp_path / "fit.log").write_text("earlier")
    for name in ("fit.log", "new.log"):
        with pytest.raises(UdccalError, match="refused"), _iterations_to(Output(), tmp_path / name):
            raise UdccalError("refused")
    assert contents(tmp_path) == {tmp_path / "fit.log": b"earlier"}
    with _iterations_to(Output(), tmp_path / "fit.log"):
        LOG.debug("a line")
    assert (tmp_path / "fit.log").read_text().endswith(" ms  a line\n")
    assert "earlier" not in (tmp_path / "fit.log").read_text()
