from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.errors import SessionError
from udccal.rig import load_rig
from udccal.sessions.schema import DarkSubject
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

CAMERA = CameraIdentity("maker", "model", "0001", "test")
RIG = load_rig("lg55-reduced")


def frame(x: int = 0) -> Frame:
    return Frame(np.zeros((8, 8), np.uint16), Settings(0.01, 0.0, Region(x, 0, 8, 8)), 0.0, 0, True)


def test_a_folder_with_other_content_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(SessionError, match="other content"):
        SessionWriter.create(tmp_path, RIG, CAMERA)
    assert [item.name for item in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_session_is_resumed_not_overwritten(tmp_path: Path) -> None:
    SessionWriter.create(tmp_path, RIG, CAMERA).add_step("noise/dark_0", "noise", DarkSubject(), [frame()])
    with pytest.raises(SessionError, match="Resume it"):
        SessionWriter.create(tmp_path, RIG, CAMERA)
    writer = SessionWriter.create_or_resume(tmp_path, RIG, CAMERA)
    assert writer.completed_ids == {"noise/dark_0"}
    writer.add_step("noise/dark_1", "noise", DarkSubject(), [frame()])
    assert [step.id for step in Session.open(tmp_path).steps("noise")] == ["noise/dark_0", "noise/dark_1"]
    with pytest.raises(SessionError, match="captured already"):
        writer.add_step("noise/dark_1", "noise", DarkSubject(), [frame()])


def test_another_rig_or_camera_does_not_go_on(tmp_path: Path) -> None:
    SessionWriter.create(tmp_path, RIG, CAMERA)
    with pytest.raises(SessionError, match="rig 'mk31-imx1600'"):
        SessionWriter.create_or_resume(tmp_path, load_rig("mk31-imx1600"), CAMERA)
    with pytest.raises(SessionError, match="found model 0001"):
        SessionWriter.create_or_resume(tmp_path, RIG, CameraIdentity("maker", "model", "0002", "test"))
    with pytest.raises(SessionError, match="found none"):
        SessionWriter.resume(tmp_path / "nowhere")


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


def test_a_failed_write_leaves_the_manifest_true(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = SessionWriter.create(tmp_path, RIG, CAMERA)
    writer.add_step("noise/dark_0", "noise", DarkSubject(), [frame()])

    def full_disk(path: Path, data: np.ndarray) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("udccal.sessions.writer.write_png16", full_disk)
    with pytest.raises(OSError, match="No space"):
        writer.add_step("noise/dark_1", "noise", DarkSubject(), [frame()])
    session = Session.open(tmp_path)
    assert [step.id for step in session.manifest.steps] == ["noise/dark_0"]
    assert session.frame(session.manifest.steps[0].captures[0]).shape == (8, 8)
