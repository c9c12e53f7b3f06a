"""A check whose flats no movement of the camera explains: no profile is written, and the page does not say what."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.drift.test_update import checked
from udccal.cli.bench_options import BenchOptions, CameraKind, DisplayKind
from udccal.cli.jobs import check as job
from udccal.cli.output import Output
from udccal.profiles.store import load_profile
from udccal.reports.check_page import check_page
from udccal.sessions.store import Session


def test_no_profile_is_written_of_a_pose_that_explains_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, solved = checked(load_profile("lg55-reduced"), ("moved",))
    found = replace(found, flat_over_noise=5.0, changed=())
    monkeypatch.setattr(BenchOptions, "capture", lambda *_: True)
    monkeypatch.setattr(Session, "open", lambda _: SimpleNamespace())
    monkeypatch.setattr(job, "check_rig", lambda *_: (found, solved))
    options = BenchOptions(CameraKind.sim, None, None, DisplayKind.manual, 0, 0, None)
    out, update = tmp_path / "out", tmp_path / "new"
    assert job.check_profile(Output(), Path("lg55-reduced"), options, False, out, update) is False
    assert not update.exists()
    assert (out / "check.json").exists()
    assert check_page(found, solved).facts[0].value == "not known"
