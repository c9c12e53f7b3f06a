"""A check into the folder of an earlier one does not judge the captures of then, nor those that cannot be used."""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Never

import pytest

from udccal.benches.bench import simulate
from udccal.cli.bench_options import BenchOptions, CameraKind, DisplayKind
from udccal.cli.jobs import check as job
from udccal.cli.jobs.capture import Wanted
from udccal.cli.output import Output
from udccal.drift.check import short_rig
from udccal.errors import CaptureError, ProfileError, SessionError, UdccalError
from udccal.planned_steps import planned_ids
from udccal.rig import RigDescription, load_rig
from udccal.sessions.changes import stored_camera
from udccal.sessions.manifest import MANIFEST_NAME, write_manifest
from udccal.sessions.schema import Manifest
from udccal.sessions.store import Session

ELSEWHERE = "apart from the captures and results"
OPTIONS = BenchOptions(CameraKind.sim, None, None, DisplayKind.manual, 0, 0, None)


def begun(folder: Path, answered: bool) -> Path:
    """A folder with the captures of an earlier check."""
    (folder / "session").mkdir()
    (folder / "session" / "session.json").write_text("{}")
    if answered:
        (folder / "check.json").write_text("{}")
        (folder / "check.html").write_text("of then")
    return folder


def stopped(_: BenchOptions, output: Output, rig: RigDescription, wanted: Wanted, *__: object) -> Never:
    """A capture that ends before its first frame."""
    assert wanted.before is not None
    with simulate(rig, 0) as bench:
        wanted.before(bench)
    raise CaptureError("The lamp is off.")


def captured(folder: Path, lacking: int) -> None:
    """The manifest of a check's session without its last steps."""
    with simulate(short_rig(load_rig("lg55-reduced")), 0) as bench:
        rig, camera = bench.rig, stored_camera(bench.camera.identity)
    planned = [(term, step_id) for term in ("wire", "backscatter") for step_id in planned_ids(term, rig)]
    steps = [
        {
            "id": step_id,
            "term": term,
            "subject": {"kind": "dark"},
            "completed_at": "2024-05-01T12:00:00+00:00",
            "captures": [
                {"kind": "frame", "file": "a.png", "sha256": "ab" * 32, "frames": 1, "exposure_s": 1.0, "gain_dB": 0.0}
                | {"region": {"x": 0, "y": 0, "columns": 2, "rows": 2}}
                | {"first_timestamp_s": 0.0, "last_timestamp_s": 0.0}
            ],
        }
        for term, step_id in planned[: len(planned) - lacking]
    ]
    document = {"format": "udccal-session", "version": 1, "created_at": "2024-05-01T12:00:00+00:00", "steps": steps}
    document |= {"rig": rig.model_dump(mode="json"), "camera": camera.model_dump(mode="json")}
    folder.mkdir()
    write_manifest(folder, Manifest.model_validate_json(json.dumps(document)))


@pytest.mark.parametrize(
    ("lacking", "days", "aside"),
    [(0, 0.0, True), (1, 0.0, False), (1, 1.1, True)],
    ids=["whole, but not compared", "interrupted today", "interrupted on another day"],
)
def test_captures_of_another_day_are_not_judged(
    tmp_path: Path, lacking: int, days: float, aside: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(BenchOptions, "capture", stopped)
    captured(tmp_path / "session", lacking)
    at = time.time() - 86400.0 * days
    os.utime(tmp_path / "session" / MANIFEST_NAME, (at, at))
    with pytest.raises(CaptureError):
        job.check_profile(Output(), Path("lg55-reduced"), OPTIONS, False, tmp_path, None)
    assert (tmp_path / "session-before").exists() is aside
    assert (tmp_path / "session").exists() is not aside


@pytest.mark.parametrize(
    ("update", "found"),
    [
        ("c", ELSEWHERE),
        ("c/session", ELSEWHERE),
        ("c/session/p", ELSEWHERE),
        ("c/check.json", ELSEWHERE),
        ("c/../c/session-before", ELSEWHERE),
        (".", ELSEWHERE),
        ("c/new", "The lamp is off"),
        ("new", "The lamp is off"),
    ],
)
def test_an_update_among_the_checks_own_files_is_refused_before_a_capture(
    tmp_path: Path, update: str, found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(BenchOptions, "capture", stopped)
    with pytest.raises(UdccalError, match=found):
        job.check_profile(Output(), Path("lg55-reduced"), OPTIONS, False, tmp_path / "c", tmp_path / update)


def test_a_check_into_a_profile_is_refused(tmp_path: Path) -> None:
    (tmp_path / "profile.json").write_text("{}")
    for out in (tmp_path, tmp_path / "deep" / "out"):
        with pytest.raises(ProfileError, match="outside of any profile"):
            job.check_profile(Output(), Path("lg55-reduced"), OPTIONS, False, out, None)
    assert [item.name for item in tmp_path.iterdir()] == ["profile.json"]


@pytest.mark.parametrize("answered", [True, False])
def test_captures_of_an_answered_check_are_put_aside(
    tmp_path: Path, answered: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
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
