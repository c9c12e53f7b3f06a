"""A check into the folder of an earlier one does not judge the captures of then, nor those that cannot be used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Never

import pytest

from udccal.benches.bench import simulate
from udccal.cli.bench_options import BenchOptions, CameraKind, DisplayKind
from udccal.cli.jobs import check as job
from udccal.cli.jobs.capture import Wanted
from udccal.cli.output import Output
from udccal.errors import CaptureError, SessionError, UdccalError
from udccal.rig import RigDescription
from udccal.sessions.store import Session

OPTIONS = BenchOptions(CameraKind.sim, None, None, DisplayKind.manual, 0, 0, None)


def begun(folder: Path, answered: bool) -> Path:
    """A folder with the captures of an earlier check."""
    (folder / "session").mkdir()
    (folder / "session" / "session.json").write_text("{}")
    if answered:
        (folder / "check.json").write_text("{}")
        (folder / "check.html").write_text("of then")
    return folder


@pytest.mark.parametrize("answered", [True, False])
def test_captures_of_an_answered_check_are_put_aside(
    tmp_path: Path, answered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(_: BenchOptions, output: Output, rig: RigDescription, wanted: Wanted, *__: object) -> Never:
        assert wanted.before is not None
        with simulate(rig, 0) as bench:
            wanted.before(bench)
        raise CaptureError("The lamp is off.")

    monkeypatch.setattr(BenchOptions, "capture", stopped)
    out = begun(tmp_path, answered)
    for _ in range(2):
        with pytest.raises(CaptureError):
            job.check_profile(Output(), Path("lg55-reduced"), OPTIONS, False, out, None)
        # One that was interrupted goes on, and so does the new one.
        assert (out / "session").exists() is not answered
        assert (out / "session-before" / "session.json").exists() is answered
        assert not (out / "check.json").exists()
        assert not (out / "check.html").exists()


@pytest.mark.parametrize(
    ("options", "found"),
    [
        (replace(OPTIONS, seed=4), "another camera"),
        (replace(OPTIONS, camera=CameraKind.files), "the folder with the pictures of each step, found none"),
    ],
    ids=["another specimen", "no pictures"],
)
def test_a_check_that_cannot_begin_leaves_the_last_one_as_it_is(
    tmp_path: Path, options: BenchOptions, found: str
) -> None:
    out = begun(tmp_path, answered=True)
    with pytest.raises(UdccalError, match=found):
        job.check_profile(Output(), Path("lg55-reduced"), options, False, out, None)
    assert (out / "check.html").read_text() == "of then"
    assert sorted(item.name for item in out.iterdir()) == ["check.html", "check.json", "session"]


def test_captures_that_cannot_be_used_are_put_aside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next check captures anew: it would else judge the same captures again, and never end."""

    def refused(*_: object) -> Never:
        raise SessionError("Expected flats that can be compared, found clipped ones.")

    monkeypatch.setattr(BenchOptions, "capture", lambda *_: True)
    monkeypatch.setattr(Session, "open", lambda _: None)
    monkeypatch.setattr(job, "check_rig", refused)
    out = begun(tmp_path, answered=False)
    with pytest.raises(SessionError, match="clipped"):
        job.check_profile(Output(), Path("lg55-reduced"), OPTIONS, False, out, None)
    assert [item.name for item in out.iterdir()] == ["session-before"]
