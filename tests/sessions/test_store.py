from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.errors import SessionError
from udccal.io.exr import write_exr
from udccal.io.hashing import sha256_file
from udccal.rig import load_rig
from udccal.sessions.captured import AveragedFrames, SingleFrame
from udccal.sessions.schema import DarkSubject, FlatSubject
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

CAMERA = CameraIdentity("maker", "model", "0001", "test")
SETTINGS = Settings(0.02, 0.0, Region(4, 8, 32, 24))
RIG = load_rig("lg55-reduced")
NESTED = "[" * 100_000


def frame(seed: int = 0, temperature_C: float | None = None) -> SingleFrame:
    data = np.random.default_rng(seed).integers(0, 4096, (24, 32)).astype(np.uint16)
    return SingleFrame(Frame(data, SETTINGS, 1.5, 7, True, temperature_C))


def average() -> AveragedFrames:
    rng = np.random.default_rng(3)
    mean, variance = rng.uniform(60, 70, (2, 24, 32)).astype(np.float32)
    return AveragedFrames(mean, variance, 16, SETTINGS, 1.0, 2.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "session"
    writer = SessionWriter.create(path, RIG, CAMERA)
    writer.add_step("noise/dark_0", "noise", DarkSubject(), [frame(0, 35.5), frame(1)])
    writer.add_step("wire/flat", "wire", FlatSubject(), [average()])
    picture = np.zeros((RIG.panel.rows, RIG.panel.columns, 3), np.uint8)
    picture[..., 1] = 9
    shown = writer.store_picture("backscatter/picture_0", picture, "picture")
    writer.add_step("backscatter/picture_0", "backscatter", shown, [average()])
    writer.close()
    return path


def edit(folder: Path, change: Callable[[dict], None]) -> None:
    file = folder / "session.json"
    content = json.loads(file.read_text())
    del content["manifest_sha256"]  # as a person would who edits it
    change(content)
    file.write_text(json.dumps(content))


def test_what_was_written_is_read(folder: Path) -> None:
    session = Session.open(folder)
    (dark,) = session.steps("noise")
    np.testing.assert_array_equal(session.frame(dark.captures[1]), frame(1).frame.data)
    found = session.average(session.step("wire/flat").captures[0])
    np.testing.assert_array_equal(found.mean, average().mean)
    np.testing.assert_array_equal(found.variance, average().variance)
    assert found.frames == 16
    (shown,) = session.steps("backscatter")
    assert session.picture(shown.subject)[5, 5].tolist() == [0, 9, 0]
    assert (session.rig, session.camera.serial) == (RIG, "0001")
    assert session.steps("psf") == ()


def test_the_temperature_is_kept_and_may_be_absent(folder: Path) -> None:
    first, second = Session.open(folder).step("noise/dark_0").captures
    assert (first.temperature_C, second.temperature_C) == (35.5, None)
    # As a session from before it was stored, or one of another program.
    edit(folder, lambda m: [c.pop("temperature_C") for s in m["steps"] for c in s["captures"]])
    assert {c.temperature_C for s in Session.open(folder).manifest.steps for c in s.captures} == {None}


def test_a_step_not_captured_and_the_wrong_kind_are_named(folder: Path) -> None:
    session = Session.open(folder)
    with pytest.raises(SessionError, match="Expected the step 'wire/dark'"):
        session.step("wire/dark")
    with pytest.raises(SessionError, match="found an average"):
        session.frame(session.step("wire/flat").captures[0])
    with pytest.raises(SessionError, match="found a single frame"):
        session.average(session.step("noise/dark_0").captures[0])


def test_a_flipped_bit_is_found(folder: Path) -> None:
    file = folder / "wire/flat_0.exr"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    session = Session.open(folder)
    with pytest.raises(SessionError, match=r"Expected 'wire/flat_0.exr' of .* SHA-256 .* changed or damaged"):
        session.average(session.step("wire/flat").captures[0])


def test_a_missing_file_is_named(folder: Path) -> None:
    (folder / "noise/dark_0_0.png").unlink()
    session = Session.open(folder)
    with pytest.raises(SessionError, match=r"Expected the file 'noise/dark_0_0.png'"):
        session.frame(session.step("noise/dark_0").captures[0])


def test_a_truncated_file_with_a_matching_checksum_is_refused(folder: Path) -> None:
    file = folder / "wire/flat_0.exr"
    file.write_bytes(file.read_bytes()[:-200])
    edit(folder, lambda m: m["steps"][1]["captures"][0].update(sha256=sha256_file(file)))
    session = Session.open(folder)
    with pytest.raises(SessionError, match="OpenEXR file, found"):
        session.average(session.step("wire/flat").captures[0])


def test_a_link_out_of_the_session_is_refused(folder: Path, tmp_path: Path) -> None:
    file = folder / "noise/dark_0_0.png"
    file.rename(tmp_path / "outside.png")
    file.symlink_to(tmp_path / "outside.png")
    session = Session.open(folder)
    with pytest.raises(SessionError, match="inside the session"):
        session.frame(session.step("noise/dark_0").captures[0])


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"mean": np.full((24, 32), 9.0)}, "channels mean and variance"),
        ({"mean": np.full((24, 30), 9.0), "variance": np.ones((24, 30))}, "to have 32 x 24 samples, found 30 x 24"),
        ({"mean": np.full((24, 32), 9e4), "variance": np.ones((24, 32))}, "at most 4095 DN"),
        ({"mean": np.full((24, 32), 9.0), "variance": -np.ones((24, 32))}, "no negative values"),
    ],
)
def test_averages_that_do_not_fit_are_refused(folder: Path, channels: dict, message: str) -> None:
    file = folder / "wire/flat_0.exr"
    write_exr(file, channels)
    edit(folder, lambda m: m["steps"][1]["captures"][0].update(sha256=sha256_file(file)))
    session = Session.open(folder)
    with pytest.raises(SessionError, match=message):
        session.average(session.step("wire/flat").captures[0])


def test_a_picture_of_another_size_is_refused(folder: Path) -> None:
    edit(folder, lambda m: m["rig"]["panel"].update(columns=1280))
    session = Session.open(folder)
    with pytest.raises(SessionError, match="to have 1280 x 1080 samples"):
        session.picture(session.steps("backscatter")[0].subject)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(extra=1), "found 'extra'. Remove it"),
        (lambda m: m["steps"][0].pop("subject"), r"an entry 'steps.0.subject' .* found none"),
        (lambda m: m["steps"][0]["captures"][0].update(exposure_s="1"), r"captures.0.exposure_s' .* found '1'"),
        (lambda m: m["steps"][0]["captures"][0].update(exposure_s=float("nan")), "exposure_s"),
        (lambda m: m["steps"][0]["captures"][0].update(file="../../etc/x.png"), r"file' .* found '../../etc/x.png'"),
        (lambda m: m["steps"][0]["captures"][0].update(file="/etc/x.png"), r"file' .* found '/etc/x.png'"),
        (lambda m: m["steps"][0]["captures"][0].update(frames=2), "frames = 1 for a single frame"),
        (lambda m: m["steps"][0]["captures"][0].update(frames=10**15), r"captures.0.frames' .* equal to 1048576"),
        (lambda m: m["steps"][0]["captures"][0].update(gain_dB=300.0), r"captures.0.gain_dB' .* equal to 200"),
        (lambda m: m["steps"][0]["captures"][0].update(kind="average"), "a file ending in .exr"),
        (lambda m: m["steps"][0]["captures"][0]["region"].update(x=1), r"region.x' .* multiple of 2"),
        (lambda m: m["steps"][0]["captures"][0]["region"].update(x=1000), "regions inside the sensor"),
        (lambda m: m["steps"][0].update(id="wire/dark_0"), "an id that begins with 'noise/'"),
        (lambda m: m["steps"].append(m["steps"][0]), "each step once, not 'noise/dark_0' twice"),
        (lambda m: m["steps"][0]["subject"].update(kind="cat"), "subject"),
        (lambda m: m["rig"]["camera"].update(cfa="RGBW"), "cfa"),
        (lambda m: m.update(version=2), "found the newer version 2. Update udccal"),
        (lambda m: m.update(version=0), "version"),
        (lambda m: m.update(format="other"), "format 'udccal-session'"),
    ],
)
def test_hand_edited_manifests_are_refused_with_a_sentence(folder: Path, change: Callable, message: str) -> None:
    edit(folder, change)
    with pytest.raises(SessionError, match=message) as caught:
        Session.open(folder)
    assert str(caught.value).startswith("Expected")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", NESTED.encode(), b"null"])
def test_manifests_that_are_not_json_objects_are_refused(folder: Path, content: bytes) -> None:
    (folder / "session.json").write_bytes(content)
    with pytest.raises(SessionError, match=r"Expected .*session.json"):
        Session.open(folder)


def test_no_session_and_a_huge_one_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="found none"):
        Session.open(tmp_path / "nowhere")
    with (tmp_path / "session.json").open("wb") as stream:
        stream.truncate(65 * 1024 * 1024)
    with pytest.raises(SessionError, match="at most 67108864 bytes"):
        Session.open(tmp_path)
