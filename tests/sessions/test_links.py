"""A session made by somebody else, with links in it: the person who goes on with it loses and gives away nothing."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.errors import SessionError
from udccal.rig import load_rig
from udccal.sessions.captured import SingleFrame
from udccal.sessions.schema import DarkSubject
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

PRIVATE = b"-----BEGIN OPENSSH PRIVATE KEY-----\n"
WHOLE = SingleFrame(Frame(np.zeros((8, 8), np.uint16), Settings(0.01, 0.0, Region(0, 0, 8, 8)), 0.0, 0, True))
PICTURE = np.zeros((4, 4, 3), np.uint8)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    with SessionWriter.create(tmp_path / "session", load_rig("lg55-reduced"), CameraIdentity("a", "b", "c", "d")) as to:
        for index in range(2):
            to.add_step(f"noise/dark_{index}", "noise", DarkSubject(), [WHOLE])
    return tmp_path / "session"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A private file next to the session."""
    folder = tmp_path / "home"
    folder.mkdir()
    (folder / "key").write_bytes(PRIVATE)
    (folder / "key").chmod(0o600)
    (folder / ".dark_0_0-0123456789ab.partial.png").write_bytes(PRIVATE)
    return folder


def everything(folder: Path) -> dict[str, bytes | None]:
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def link(session: Path, name: str, target: Path) -> None:
    place = session / name
    shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
    place.symlink_to(target)


def broken(session: Path, home: Path) -> None:
    (session / "session.json").write_text("{")


def damaged_leads_out(session: Path, home: Path) -> None:
    broken(session, home)
    link(session, "session.damaged.json", home / "key")


def manifest_leads_out(session: Path, home: Path) -> None:
    link(session, "session.json", home / "key")


def manifest_leads_to_a_manifest(session: Path, home: Path) -> None:
    shutil.copy(session / "session.json", home / "other.json")
    link(session, "session.json", home / "other.json")


def previous_leads_out(session: Path, home: Path) -> None:
    link(session, "session.previous.json", home / "key")


def lock_leads_out(session: Path, home: Path) -> None:
    link(session, ".session.lock", home / "key")


def lock_leads_to_nothing(session: Path, home: Path) -> None:
    link(session, ".session.lock", home / "new")


def frame_leads_out(session: Path, home: Path) -> None:
    link(session, "noise/dark_0_0.png", home / "key")


def next_frame_leads_out(session: Path, home: Path) -> None:
    link(session, "noise/dark_2_0.png", home / "key")


def next_picture_leads_out(session: Path, home: Path) -> None:
    link(session, "noise/dark_2_shown.png", home / "key")


def folder_leads_out(session: Path, home: Path) -> None:
    link(session, "noise", home)


def folder_leads_inside(session: Path, home: Path) -> None:
    (session / "noise").rename(session / "wire")
    (session / "noise").symlink_to("wire")


LINKS: list[Callable[[Path, Path], None]] = [
    damaged_leads_out,
    manifest_leads_out,
    manifest_leads_to_a_manifest,
    previous_leads_out,
    lock_leads_out,
    lock_leads_to_nothing,
    frame_leads_out,
    next_frame_leads_out,
    next_picture_leads_out,
    folder_leads_out,
    folder_leads_inside,
]


@pytest.mark.parametrize("lay", LINKS)
def test_going_on_with_a_session_follows_no_link(session: Path, home: Path, lay: Callable[[Path, Path], None]) -> None:
    lay(session, home)
    before = everything(home)
    with suppress(SessionError), SessionWriter.resume(session) as writer:
        writer.store_picture("noise/dark_2", PICTURE, "white")
        writer.add_step("noise/dark_2", "noise", DarkSubject(), [WHOLE])
        for again in sorted({damage.step_id for damage in writer.damage}):
            writer.add_step(again, "noise", DarkSubject(), [WHOLE])
    assert everything(home) == before
    assert not [path for path in session.rglob("*") if path.is_file() and not path.is_symlink() and _private(path)]


def _private(path: Path) -> bool:
    return PRIVATE in path.read_bytes()


@pytest.mark.parametrize("target", ["home", "session/noise"])
def test_a_step_captured_again_removes_nothing_behind_a_link(session: Path, home: Path, target: str) -> None:
    other = session.parent / target
    (other / "photo.png").write_bytes(PRIVATE)
    (session / "album").symlink_to(other)
    manifest = json.loads((session / "session.json").read_text())
    del manifest["manifest_sha256"]
    manifest["steps"][0]["captures"][0]["file"] = "album/photo.png"
    (session / "session.json").write_text(json.dumps(manifest))
    with SessionWriter.resume(session) as writer:
        assert [damage.file for damage in writer.damage] == ["album/photo.png"]
        writer.add_step("noise/dark_0", "noise", DarkSubject(), [WHOLE])
    assert (other / "photo.png").read_bytes() == PRIVATE


@pytest.mark.parametrize("lay", [damaged_leads_out, manifest_leads_out, manifest_leads_to_a_manifest])
def test_a_manifest_is_recovered_beside_links(session: Path, home: Path, lay: Callable[[Path, Path], None]) -> None:
    lay(session, home)
    with SessionWriter.resume(session) as writer:
        assert writer.recovered
        writer.add_step("noise/dark_1", "noise", DarkSubject(), [WHOLE])
    assert not (session / "session.json").is_symlink()
    assert len(Session.open(session).manifest.steps) == 2


@pytest.mark.parametrize("name", ["noise/dark_2", "noise/deeper/dark_2"])
def test_no_folder_is_made_behind_a_link(session: Path, home: Path, name: str) -> None:
    with SessionWriter.resume(session) as writer:
        link(session, "noise", home)
        before = everything(home)
        with pytest.raises(SessionError, match="noise is a link; remove it"):
            writer.add_step(name, "noise", DarkSubject(), [WHOLE])
    assert everything(home) == before


def test_a_reader_follows_no_link(session: Path, home: Path) -> None:
    manifest_leads_to_a_manifest(session, home)
    with pytest.raises(SessionError, match="found a link"):
        Session.open(session)
    os.replace(session / "session.previous.json", session / "session.json")
    folder_leads_inside(session, home)
    opened = Session.open(session)
    with pytest.raises(SessionError, match="inside the session"):
        opened.frame(opened.step("noise/dark_0").captures[0])


def test_the_session_itself_may_be_a_link(session: Path) -> None:
    session.with_name("latest").symlink_to(session)
    with SessionWriter.resume(session.with_name("latest")) as writer:
        writer.add_step("noise/dark_2", "noise", DarkSubject(), [WHOLE])
        assert writer.damage == ()
    assert len(Session.open(session).manifest.steps) == 3
