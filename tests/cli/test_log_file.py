from __future__ import annotations

from pathlib import Path

import pytest

from udccal.cameras.protocol import CameraIdentity
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
