"""``udccal restore --explain`` and ``--plan`` on files: what is printed, what is pinned, what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import typer

from udccal.cli.jobs import explain
from udccal.cli.jobs.explain import Frames, Plans, explain_plan
from udccal.cli.jobs.restore import restore_files
from udccal.cli.output import Output
from udccal.cli.restore import TierChoice, restore
from udccal.errors import FileFormatError, ProfileError, RestorationError, UdccalError
from udccal.io.png import write_png16, write_rgb8
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.store import write_profile
from udccal.restoration import planner
from udccal.restoration.frame_time import PartTimes
from udccal.restoration.scene_plan import Wish
from udccal.result import FitStatus
from udccal.rig import load_rig
from udccal.tiers import Tier

TIMES = PartTimes(*(np.array(seconds) for seconds in (1e-8, 4e-8, 1e-7, 5e-8, 1e-6, 2e-8, 1e-8, 3e-7, 1e-7, 1e-2)))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, profile: Profile, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a profile without a psf, a frame and two panel pictures; a cache of its own; known times."""
    monkeypatch.setenv("UDCCAL_COMPILATIONS", str(tmp_path / "cache"))
    monkeypatch.setattr("udccal.cli.jobs.explain.keep_compilations", lambda: None)
    monkeypatch.setattr("udccal.cli.jobs.restore.keep_compilations", lambda: None)
    monkeypatch.setattr(planner, "part_times", lambda *_: TIMES)
    write_profile(tmp_path / "profile", replace(profile, psf=replace(profile.psf, status=FitStatus.ABSENT)))
    camera, panel = profile.rig.camera, profile.rig.panel
    write_png16(tmp_path / "frame.png", np.full((camera.rows, camera.columns), 900, np.uint16))
    write_rgb8(tmp_path / "black.png", np.zeros((panel.rows, panel.columns, 3), np.uint8))
    write_rgb8(tmp_path / "small.png", np.zeros((panel.rows, panel.columns - 1, 3), np.uint8))
    return tmp_path


def frames(folder: Path, shown: str | None = None) -> Frames:
    return Frames([folder / "frame.png"], folder / "profile", None if shown is None else folder / shown, 0.02)


def test_it_says_what_would_be_done_and_restores_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("udccal.restoration.runtime.Restorer.restore", lambda *_: pytest.fail("restored"))
    explain_plan(Output(), frames(folder, "black.png"), Plans(Wish(), None), None)
    said = capsys.readouterr().out
    for words in (
        "wire",
        "backscatter",
        "left out",
        "the panel is black",
        "preview",
        "balanced",
        "chosen",
        "ms a frame",
    ):
        assert words in said
    assert not (folder / "out").exists()


def test_json_and_the_file_are_one_plan_that_can_be_pinned(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    explain_plan(Output(as_json=True), frames(folder, "black.png"), Plans(Wish(budget_ms=0.1), None), folder / "made")
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((folder / "made" / "plan.json").read_text(encoding="utf-8"))
    assert printed["tier"] == "preview"
    monkeypatch.setattr(explain, "planned", lambda *_: pytest.fail("planned anew"))
    pinned = Plans(Wish(), folder / "made" / "plan.json")
    restore_files(Output(as_json=True), frames(folder), pinned, folder / "out", "png")
    assert json.loads(capsys.readouterr().out)["tier"] == "preview"
    assert (folder / "out" / "frame.png").exists()


def test_a_pinned_plan_that_leaves_out_what_a_frame_needs_is_refused(folder: Path, profile: Profile) -> None:
    lit = replace(profile, backscatter_mask=profile.backscatter_mask + np.float32(2e4))
    write_profile(folder / "lit", replace(lit, psf=replace(lit.psf, status=FitStatus.ABSENT)))
    of_lit = replace(frames(folder, "black.png"), profile=folder / "lit")
    explain_plan(Output(), of_lit, Plans(Wish(), None), folder / "made")
    pinned = Plans(Wish(), folder / "made" / "plan.json")
    with pytest.raises(RestorationError, match=r"the stage backscatter, which these frames need .* leaves it out"):
        restore_files(Output(), replace(of_lit, panel_picture=None), pinned, folder / "out", "png")
    assert not (folder / "out").exists()


def test_without_a_wish_it_restores_at_the_most_accurate_tier(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    restore_files(Output(as_json=True), frames(folder), Plans(Wish(), None), folder / "out", "png")
    assert json.loads(capsys.readouterr().out)["tier"] == "balanced"


def test_a_folder_that_holds_a_profile_is_refused(folder: Path) -> None:
    """An image called wire_map would overwrite the profile's own with --format exr."""
    (folder / "frame.png").rename(folder / "wire_map.png")
    given = replace(frames(folder), images=[folder / "wire_map.png"])
    before = {file: file.read_bytes() for file in (folder / "profile").iterdir()}
    for out in (folder / "profile", folder / "profile" / "sub"):
        with pytest.raises(ProfileError, match=r"inside the profile .*, which holds its own files only"):
            restore_files(Output(), given, Plans(Tier.preview, None), out, "exr")
    assert {file: file.read_bytes() for file in (folder / "profile").iterdir()} == before


def test_no_plan_is_written_into_a_profile_or_a_session(folder: Path) -> None:
    (folder / "session").mkdir()
    (folder / "session" / "session.json").write_text("{}")
    (folder / "link").symlink_to(folder / "profile")
    before = sorted(folder.rglob("*"))
    for out, words in (("profile", "inside the profile"), ("link", "inside the profile"), ("session", "the session")):
        with pytest.raises(UdccalError, match=words):
            explain_plan(Output(), frames(folder), Plans(Wish(), None), folder / out)
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(("out", "image"), [("out\udcff", "frame.png"), ("out", "frame\udcff.png")])
def test_an_exr_file_that_cannot_be_named_is_refused_before_the_work(
    folder: Path, out: str, image: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("udccal.cli.jobs.restore.read_scene", lambda *_: pytest.fail("worked"))
    given = replace(frames(folder), images=[folder / image])
    with pytest.raises(FileFormatError, match="the path of an EXR file in UTF-8"):
        restore_files(Output(), given, Plans(Tier.preview, None), folder / out, "exr")
    assert not (folder / out).exists()


@pytest.mark.medium
def test_what_was_written_before_a_frame_that_is_refused_is_told(folder: Path, profile: Profile) -> None:
    rig = profile.rig.model_copy(update={"panel": load_rig("lg55-reduced").panel})
    lit = build_profile(rig, profile.provenance, *profile.results, profile.wire_map)
    write_profile(folder / "lit", replace(lit, psf=replace(lit.psf, status=FitStatus.ABSENT)))
    write_rgb8(folder / "white.png", np.full((rig.panel.rows, rig.panel.columns, 3), 255, np.uint8))
    write_png16(folder / "dark.png", np.full((rig.camera.rows, rig.camera.columns), 64, np.uint16))
    images = [folder / "frame.png", folder / "dark.png"]
    given = Frames(images, folder / "lit", folder / "white.png", float(200 / lit.backscatter_mask.mean()))
    with pytest.raises(RestorationError, match=r"dark\.png: .* Written before: .*frame\.png"):
        restore_files(Output(), given, Plans(Tier.fast, None), folder / "out", "png")
    assert [file.name for file in (folder / "out").iterdir()] == ["frame.png"]


@pytest.mark.parametrize("name", ["frame.png", "shown.png"])
def test_no_picture_that_was_given_is_overwritten(folder: Path, name: str) -> None:
    (folder / "raw").mkdir()
    (folder / "frame.png").rename(folder / "raw" / name)
    (folder / "black.png").rename(folder / "shown.png")
    given = Frames([folder / "raw" / name], folder / "profile", folder / "shown.png", 0.02)
    if name == "frame.png":
        restore_files(Output(), given, Plans(Tier.preview, None), folder, "png")
        return
    with pytest.raises(RestorationError, match=r"shown\.png for .* is taken"):
        restore_files(Output(), given, Plans(Tier.preview, None), folder, "png")


def test_what_does_not_belong_to_the_profile_is_refused_before_any_work(
    folder: Path, profile: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("udccal.cli.jobs.restore.Restorer", None)
    output, out = Output(), folder / "out"
    explain_plan(output, frames(folder), Plans(Wish(), None), folder / "made")
    other = replace(profile, wire_map=profile.wire_map * np.float32(1.01))
    write_profile(folder / "other", other)
    of_other = replace(frames(folder), profile=folder / "other")
    pinned = Plans(Wish(), folder / "made" / "plan.json")
    with pytest.raises(RestorationError, match="Expected a plan of this profile"):
        restore_files(output, of_other, pinned, out, "png")
    with pytest.raises(FileFormatError, match="32 x 24 samples, found 31 x 24"):
        restore_files(output, frames(folder, "small.png"), Plans(Wish(), None), out, "png")
    with pytest.raises(RestorationError, match=r"frame\.png: Expected a budget of at least"):
        restore_files(output, frames(folder), Plans(Wish(budget_ms=1e-6), None), out, "png")
    shipped = replace(frames(folder), profile=Path("lg55-reduced"))
    with pytest.raises(FileFormatError, match="1024 x 768 samples, found 96 x 64"):
        restore_files(output, shipped, Plans(Tier.fast, None), out, "png")
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "needed unless --explain"),
        ({"out": Path("o"), "tier": TierChoice.fast, "budget_ms": 5.0}, "takes neither another --tier nor --plan"),
        ({"out": Path("o"), "plan": Path("p"), "min_psnr": 30.0}, "takes neither another --tier nor --plan"),
        ({"out": Path("o"), "plan": Path("p"), "tier": TierChoice.fast}, "takes neither --tier nor --explain"),
        ({"out": Path("o"), "plan": Path("p"), "tier": TierChoice.auto}, "takes neither --tier nor --explain"),
        ({"plan": Path("p"), "explain": True}, "takes neither --tier nor --explain"),
    ],
)
def test_options_that_contradict_each_other_are_wrong_words(options: dict[str, Any], said: str) -> None:
    with pytest.raises(typer.BadParameter, match=said):
        restore(MagicMock(spec=typer.Context), [Path("frame.png")], Path("p"), **options)
