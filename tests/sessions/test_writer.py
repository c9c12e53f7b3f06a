from __future__ import annotations

import errno
import json
import multiprocessing
import os
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.errors import SessionError
from udccal.io.hashing import sha256_file
from udccal.rig import RigDescription, load_rig
from udccal.sessions.captured import AveragedFrames, SingleFrame
from udccal.sessions.changes import Exchanged
from udccal.sessions.schema import MOST_CHANGES, DarkSubject, FlatSubject, Manifest
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

CAMERA = CameraIdentity("maker", "model", "0001", "test")
OTHER_CAMERA = replace(CAMERA, serial="0002")
RIG = load_rig("lg55-reduced")


def frame(x: int = 0, level: int = 0) -> SingleFrame:
    data = np.full((8, 8), level, np.uint16)
    return SingleFrame(Frame(data, Settings(0.01, 0.0, Region(x, 0, 8, 8)), 0.0, 0, True))


def average(rows: int = 64) -> AveragedFrames:
    mean, variance = np.random.default_rng(0).uniform(60, 70, (2, rows, 64)).astype(np.float32)
    return AveragedFrames(mean, variance, 16, Settings(0.01, 0.0, Region(0, 0, 64, rows)), 1.0, 2.0)


def with_other_lens() -> RigDescription:
    return RIG.model_copy(update={"lens": RIG.lens.model_copy(update={"model": "8 mm f/2"})})


def three_steps(folder: Path) -> None:
    with SessionWriter.create(folder, RIG, CAMERA) as writer:
        for index in range(3):
            writer.add_step(f"noise/dark_{index}", "noise", DarkSubject(), [frame(level=index), frame(level=9)])


def test_a_folder_with_other_content_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(SessionError, match="other content"):
        SessionWriter.create(tmp_path, RIG, CAMERA)
    assert [item.name for item in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize("serial", ["1" * 101, "\udcff"])
def test_a_camera_that_says_too_much_of_itself_is_refused(tmp_path: Path, serial: str) -> None:
    with pytest.raises(SessionError, match="Expected the 'serial' of the camera to be a text of at most 100"):
        SessionWriter.create(tmp_path, RIG, replace(CAMERA, serial=serial))
    with SessionWriter.create(tmp_path, RIG, CAMERA) as writer:
        assert writer.manifest.steps == ()


def test_a_session_is_resumed_not_overwritten(tmp_path: Path) -> None:
    with SessionWriter.create(tmp_path, RIG, CAMERA) as writer:
        writer.add_step("noise/dark_0", "noise", DarkSubject(), [frame()])
    with pytest.raises(SessionError, match="Resume it"):
        SessionWriter.create(tmp_path, RIG, CAMERA)
    with SessionWriter.create_or_resume(tmp_path, RIG, CAMERA) as writer:
        assert writer.completed_ids == {"noise/dark_0"}
        assert (writer.number("noise/dark_0"), writer.number("noise/dark_1")) == (0, 1)
        writer.add_step("noise/dark_1", "noise", DarkSubject(), [frame()])
        with pytest.raises(SessionError, match="already captured"):
            writer.add_step("noise/dark_1", "noise", DarkSubject(), [frame()])
    assert [step.id for step in Session.open(tmp_path).steps("noise")] == ["noise/dark_0", "noise/dark_1"]


def test_times_are_those_of_the_bench(tmp_path: Path) -> None:
    noon = datetime(2024, 5, 1, 12, tzinfo=UTC)
    with SessionWriter.create(tmp_path, RIG, CAMERA, now=lambda: noon) as writer:
        step = writer.add_step("noise/dark_0", "noise", DarkSubject(), [frame()])
    assert step.completed_at == writer.manifest.created_at == "2024-05-01T12:00:00+00:00"


@pytest.mark.parametrize("step_id", ["noise/../../x", "/noise/x", "noise/", "noise/a b", "wire/dark"])
def test_ids_that_do_not_fit_are_refused(tmp_path: Path, step_id: str) -> None:
    writer = SessionWriter.create(tmp_path / "session", RIG, CAMERA)
    with pytest.raises(SessionError, match="Expected"):
        writer.add_step(step_id, "noise", DarkSubject(), [frame()])
    assert writer.completed_ids == frozenset()
    assert Session.open(tmp_path / "session").manifest.steps == ()
    assert [item.name for item in tmp_path.iterdir()] == ["session"]


def test_a_region_outside_the_sensor_is_refused(tmp_path: Path) -> None:
    writer = SessionWriter.create(tmp_path, RIG, CAMERA)
    with pytest.raises(SessionError, match="regions inside the sensor"):
        writer.add_step("noise/dark_0", "noise", DarkSubject(), [frame(x=1020)])
    assert Session.open(tmp_path).manifest.steps == ()


def _hold(folder: Path, ready, leave) -> None:
    with SessionWriter.resume(folder):
        ready.set()
        leave.wait(30)


def test_a_second_process_is_refused_until_the_first_ends(tmp_path: Path) -> None:
    three_steps(tmp_path)
    context = multiprocessing.get_context("fork")
    ready, leave = context.Event(), context.Event()
    other = context.Process(target=_hold, args=(tmp_path, ready, leave))
    other.start()
    assert ready.wait(30)
    with pytest.raises(SessionError, match="another process is writing to it"):
        SessionWriter.resume(tmp_path)
    Session.open(tmp_path)  # reading is free
    other.kill()  # nothing is left locked behind a killed process
    other.join(30)
    with SessionWriter.resume(tmp_path) as writer, pytest.raises(SessionError, match="another process"):
        SessionWriter.create_or_resume(tmp_path, RIG, CAMERA)
    assert len(writer.completed_ids) == 3


def test_another_rig_camera_or_lens_does_not_go_on_unless_told(tmp_path: Path) -> None:
    three_steps(tmp_path)
    with pytest.raises(SessionError, match="rig 'mk31-imx1600'"):
        SessionWriter.create_or_resume(tmp_path, load_rig("mk31-imx1600"), CAMERA)
    with pytest.raises(SessionError, match=r"of the camera maker model 0002, found maker model 0001\. Put"):
        SessionWriter.create_or_resume(tmp_path, RIG, OTHER_CAMERA, {Exchanged.LENS})
    with pytest.raises(SessionError, match=r"of the lens 8 mm f/2 .*6 ± 0.1 mm.*\(--exchanged lens\)"):
        SessionWriter.create_or_resume(tmp_path, with_other_lens(), CAMERA, {Exchanged.CAMERA})
    with pytest.raises(SessionError, match="found none"):
        SessionWriter.resume(tmp_path / "nowhere")
    before = (tmp_path / "session.json").read_bytes()
    SessionWriter.create_or_resume(tmp_path, RIG, CAMERA, {Exchanged.CAMERA}).close()
    assert (tmp_path / "session.json").read_bytes() == before  # nothing was exchanged, nothing is noted
    with SessionWriter.create_or_resume(tmp_path, with_other_lens(), OTHER_CAMERA, set(Exchanged)) as writer:
        writer.add_step("noise/dark_3", "noise", DarkSubject(), [frame()])
    manifest = Session.open(tmp_path).manifest
    assert [change.what for change in manifest.changes] == ["camera", "lens"]
    assert [step.after_changes for step in manifest.steps] == [0, 0, 0, 2]
    assert (manifest.camera.serial, manifest.rig.lens.model) == ("0002", "8 mm f/2")
    by_another_backend = replace(OTHER_CAMERA, backend="other", vendor="MAKER")
    SessionWriter.create_or_resume(tmp_path, with_other_lens(), by_another_backend).close()
    SessionWriter.create_or_resume(tmp_path, with_other_lens(), OTHER_CAMERA).close()


def test_no_more_exchanges_are_noted_than_can_be_read(tmp_path: Path) -> None:
    three_steps(tmp_path)
    for number in range(MOST_CHANGES):
        camera = CAMERA if number % 2 else OTHER_CAMERA
        SessionWriter.create_or_resume(tmp_path, RIG, camera, {Exchanged.CAMERA}).close()
    with pytest.raises(SessionError, match=r"Expected at most 100 exchanges .* Begin a new"):
        SessionWriter.create_or_resume(tmp_path, RIG, OTHER_CAMERA, {Exchanged.CAMERA})
    assert len(Session.open(tmp_path).manifest.changes) == MOST_CHANGES


def test_a_step_stays_until_the_one_that_replaces_it_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    three_steps(tmp_path)
    before = Session.open(tmp_path)
    old = before.step("noise/dark_1")
    with SessionWriter.resume(tmp_path) as writer:
        writer.capture_again(["noise/dark_1"])
        assert writer.completed_ids == {"noise/dark_0", "noise/dark_2"}
        with monkeypatch.context() as patch:  # the process ends between the files and the manifest
            patch.setattr("udccal.sessions.writer.write_manifest", _killed)
            with pytest.raises(KeyboardInterrupt):
                writer.add_step("noise/dark_1", "noise", DarkSubject(), [frame(level=5), frame(level=6)])
    for level, capture in zip((1, 9), old.captures, strict=True):
        assert int(before.frame(capture).max()) == level
    for level in (7, 8):  # twice, so that the names are free again
        with SessionWriter.resume(tmp_path) as writer:
            assert writer.damage == ()
            writer.capture_again(["noise/dark_1"])
            writer.add_step("noise/dark_1", "noise", DarkSubject(), [frame(level=level), frame(level=9)])
        after = Session.open(tmp_path)
        assert [step.id for step in after.manifest.steps] == [f"noise/dark_{index}" for index in range(3)]
        assert int(after.frame(after.step("noise/dark_1").captures[0]).max()) == level
        named = {capture.file for step in after.manifest.steps for capture in step.captures}
        assert {f"noise/{path.name}" for path in (tmp_path / "noise").iterdir()} == named
    assert after.step("noise/dark_1").captures[0].file == old.captures[0].file


def _killed(folder: Path, manifest: Manifest) -> None:
    raise KeyboardInterrupt


def test_a_step_captured_again_leaves_out_those_that_do_not_go_with_it(tmp_path: Path) -> None:
    three_steps(tmp_path)
    with SessionWriter.resume(tmp_path) as writer:
        with pytest.raises(SessionError, match="'noise/dark_7' was not captured"):
            writer.capture_again(["noise/dark_0", "noise/dark_7"])
        assert len(writer.completed_ids) == 3
        writer.capture_again(["noise/dark_0"])
        shown = writer.store_picture(
            "noise/dark_0", np.zeros((RIG.panel.rows, RIG.panel.columns, 3), np.uint8), "white"
        )
        assert shown.picture == "noise/dark_0-2_shown.png"
        writer.add_step("noise/dark_0", "noise", DarkSubject(), [frame()], without=["noise/dark_2"])
        assert writer.completed_ids == {"noise/dark_0", "noise/dark_1"}
    assert not (tmp_path / "noise" / "dark_2_0.png").exists()
    assert SessionWriter.resume(tmp_path).damage == ()


@pytest.mark.parametrize("harm", ["flip", "truncate", "remove"])
def test_a_damaged_file_is_named_and_captured_again_alone(tmp_path: Path, harm: str) -> None:
    three_steps(tmp_path)
    whole = (tmp_path / "noise" / "dark_1_0.png").read_bytes()
    manifest = Session.open(tmp_path).manifest
    harmed = {"flip": whole[:40] + bytes([whole[40] ^ 1]) + whole[41:], "truncate": whole[:-7], "remove": None}[harm]
    if harmed is None:
        (tmp_path / "noise" / "dark_1_0.png").unlink()
    else:
        (tmp_path / "noise" / "dark_1_0.png").write_bytes(harmed)
    with SessionWriter.resume(tmp_path) as writer:
        (damage,) = writer.damage
        assert (damage.step_id, damage.file) == ("noise/dark_1", "noise/dark_1_0.png")
        assert damage.what == ("missing" if harm == "remove" else "changed")
        assert writer.completed_ids == {"noise/dark_0", "noise/dark_2"}
        assert writer.number("noise/dark_1") == 1
        writer.add_step("noise/dark_1", "noise", DarkSubject(), [frame(level=1), frame(level=9)])
        assert len(writer.completed_ids) == 3
    again = Session.open(tmp_path)
    assert [step.captures for step in again.manifest.steps] == [step.captures for step in manifest.steps]
    assert int(again.frame(again.step("noise/dark_1").captures[0]).max()) == 1
    with SessionWriter.resume(tmp_path) as writer:
        assert writer.damage == ()


def test_every_flipped_bit_of_the_manifest_is_noticed_and_costs_one_step(tmp_path: Path) -> None:
    three_steps(tmp_path / "whole")
    content = (tmp_path / "whole" / "session.json").read_bytes()
    rng = np.random.default_rng(5)
    a_number = content.index(b'"frames": 1') + len(b'"frames": ')
    for place in (*rng.integers(0, 8 * len(content), 60).tolist(), *range(8 * a_number, 8 * a_number + 8)):
        folder = tmp_path / "harmed"
        shutil.copytree(tmp_path / "whole", folder)
        harmed = bytearray(content)
        harmed[place // 8] ^= 1 << (place % 8)
        (folder / "session.json").write_bytes(harmed)
        with pytest.raises(SessionError, match="Expected"):
            Session.open(folder)
        with SessionWriter.resume(folder) as writer:
            assert writer.recovered
            assert writer.completed_ids == {"noise/dark_0", "noise/dark_1"}
        assert len(Session.open(folder).manifest.steps) == 2
        shutil.rmtree(folder)


def test_a_lost_manifest_is_recovered_and_two_lost_ones_are_said(tmp_path: Path) -> None:
    three_steps(tmp_path)
    (tmp_path / "session.json").unlink()
    with SessionWriter.create_or_resume(tmp_path, RIG, CAMERA) as writer:
        assert writer.recovered
    (tmp_path / "session.json").write_text("{")
    (tmp_path / "session.previous.json").write_text("{")
    with pytest.raises(SessionError, match=r"Expected .*session\.json to be JSON"):
        SessionWriter.resume(tmp_path)
    (tmp_path / "session.json").unlink()
    (tmp_path / "session.previous.json").unlink()
    with pytest.raises(SessionError, match="other content"):
        SessionWriter.create_or_resume(tmp_path, RIG, CAMERA)


def test_a_manifest_without_a_seal_is_read_and_a_newer_one_is_not_replaced(tmp_path: Path) -> None:
    three_steps(tmp_path)
    file = tmp_path / "session.json"
    content = json.loads(file.read_text())
    del content["manifest_sha256"]
    file.write_text(json.dumps(content))
    assert len(Session.open(tmp_path).manifest.steps) == 3
    file.write_text(json.dumps(content | {"version": 2}))
    newer = file.read_bytes()
    with pytest.raises(SessionError, match="newer version 2"):
        SessionWriter.resume(tmp_path)
    assert file.read_bytes() == newer


def test_leftovers_of_a_killed_process_are_removed_and_nothing_else(tmp_path: Path) -> None:
    three_steps(tmp_path)
    leftovers = [
        tmp_path / "noise" / ".dark_3_0-0123456789ab.partial.png",
        tmp_path / ".session-0123456789ab.partial.json",
    ]
    kept = [tmp_path / "notes.txt", tmp_path / "noise" / "dark_3_0.png", tmp_path / ".my.partial.png"]
    for path in (*leftovers, *kept):
        path.write_bytes(b"x")
    SessionWriter.resume(tmp_path).close()
    assert not any(path.exists() for path in leftovers)
    assert all(path.exists() for path in kept)


def test_a_process_killed_while_it_begins_a_session_leaves_a_folder_to_begin_in(tmp_path: Path) -> None:
    (tmp_path / ".session-0123456789ab.partial.json").write_text("{")
    (tmp_path / ".session.lock").touch()
    SessionWriter.create_or_resume(tmp_path, RIG, CAMERA).close()
    assert not list(tmp_path.glob("*.partial*"))
    assert Session.open(tmp_path).manifest.steps == ()


def test_an_edited_manifest_that_is_wrong_is_kept_aside(tmp_path: Path) -> None:
    three_steps(tmp_path)
    content = json.loads((tmp_path / "session.json").read_text())
    del content["manifest_sha256"]
    edited = json.dumps(content | {"crated_at": "today"})
    (tmp_path / "session.json").write_text(edited)
    with SessionWriter.resume(tmp_path) as writer:
        assert writer.recovered
    assert (tmp_path / "session.damaged.json").read_text() == edited


def test_an_unreadable_file_is_damage_to_the_writer_and_a_sentence_to_the_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    three_steps(tmp_path)

    def bad_sector(path: Path) -> str:
        if path.name == "dark_1_0.png":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return sha256_file(path)

    monkeypatch.setattr("udccal.sessions.damage.sha256_file", bad_sector)
    monkeypatch.setattr("udccal.sessions.store.sha256_file", bad_sector)
    with SessionWriter.resume(tmp_path) as writer:
        assert [(item.file, item.what) for item in writer.damage] == [("noise/dark_1_0.png", "unreadable")]
    session = Session.open(tmp_path)
    with pytest.raises(SessionError, match="Input/output error"):
        session.frame(session.step("noise/dark_1").captures[0])


def test_nothing_is_written_through_a_link_out_of_the_session(tmp_path: Path) -> None:
    three_steps(tmp_path / "session")
    (tmp_path / "session" / "noise").rename(tmp_path / "elsewhere")
    (tmp_path / "session" / "noise").symlink_to(tmp_path / "elsewhere")
    before = {path.name: path.read_bytes() for path in (tmp_path / "elsewhere").iterdir()}
    with SessionWriter.resume(tmp_path / "session") as writer:
        assert {item.what for item in writer.damage} == {"missing"}
        with pytest.raises(SessionError, match="noise is a link; remove it"):
            writer.add_step("noise/dark_0", "noise", DarkSubject(), [frame(level=7)])
    assert {path.name: path.read_bytes() for path in (tmp_path / "elsewhere").iterdir()} == before


@pytest.mark.parametrize("failing", range(12))
def test_a_full_disk_at_any_write_leaves_the_session_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    three_steps(tmp_path)
    left = failing
    real = os.fsync

    def fsync(descriptor: int) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(descriptor)

    with SessionWriter.resume(tmp_path) as writer:
        monkeypatch.setattr(os, "fsync", fsync)
        captures = [frame(level=5), average(), frame(level=6)]
        if failing < 10:  # two for each of five files
            with pytest.raises(SessionError, match=r"No space left on device\. Free some space there, then run"):
                writer.add_step("wire/flat", "wire", FlatSubject(), captures)
        else:
            writer.add_step("wire/flat", "wire", FlatSubject(), captures)
    monkeypatch.setattr(os, "fsync", real)
    assert not list(tmp_path.rglob("*.partial*"))
    with SessionWriter.resume(tmp_path) as writer:
        assert writer.damage == ()
        assert {f"noise/dark_{index}" for index in range(3)} <= writer.completed_ids
        if "wire/flat" not in writer.completed_ids:
            writer.add_step("wire/flat", "wire", FlatSubject(), captures)
    session = Session.open(tmp_path)
    np.testing.assert_array_equal(session.average(session.step("wire/flat").captures[1]).mean, average().mean)
