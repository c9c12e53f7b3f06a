"""A session that somebody has altered: what no capture gives is refused in a sentence, before any work."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.io.limits import MAX_PICTURE_BYTES
from udccal.rig import load_rig
from udccal.sessions.captured import AveragedFrames, SingleFrame
from udccal.sessions.schema import DarkSubject, FlatSubject
from udccal.sessions.writer import SessionWriter


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session with one dark frame, taken at 35 degrees Celsius, and flats and darks of the wire."""
    settings = Settings(0.02, 0.0, Region(0, 0, 32, 24))
    dark = SingleFrame(Frame(np.full((24, 32), 64, np.uint16), settings, 1.0, 0, True, 35.0))
    with SessionWriter.create(tmp_path / "s", load_rig("lg55-reduced"), CameraIdentity("m", "m", "1", "t")) as writer:
        writer.add_step("noise/dark_0", "noise", DarkSubject(), [dark])
        for name, level, subject in (("flat", 2000, FlatSubject()), ("dark", 64, DarkSubject())):
            mean = np.full((24, 32), level, np.float32)
            writer.add_step(f"wire/{name}", "wire", subject, [AveragedFrames(mean, mean, 16, settings, 1.0, 2.0)])
    return tmp_path / "s"


def refused(session: Path) -> str:
    """The sentence with which a fit of the session ends."""
    command = [sys.executable, "-m", "udccal.cli.main", "fit", str(session), "--profile", str(session.parent / "p")]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert not (session.parent / "p").exists()
    return str(json.loads(done.stdout)["error"])


@pytest.mark.parametrize("found", ["NaN", "1e9", "-1e9", "Infinity", '"warm"', "[35.0]"])
def test_a_temperature_that_can_be_none_is_refused(session: Path, found: str) -> None:
    file = session / "session.json"
    content = json.loads(file.read_text())
    del content["manifest_sha256"]
    text = json.dumps(content).replace('"temperature_C": 35.0', f'"temperature_C": {found}')
    assert found in text
    file.write_text(text)
    assert refused(session).startswith("Expected a valid 'steps.0.captures.0.temperature_C' in")


def test_a_file_larger_than_any_capture_is_refused_unread(session: Path) -> None:
    file = session / "wire" / "flat_0.exr"
    os.truncate(file, 1 << 40)  # holes, which take no room on the disk, and an hour to read
    assert refused(session).startswith(f"Expected {file} to hold at most {MAX_PICTURE_BYTES} bytes, found {1 << 40}.")
    with SessionWriter.resume(session) as writer:
        assert [(damage.file, damage.what) for damage in writer.damage] == [("wire/flat_0.exr", "changed")]
