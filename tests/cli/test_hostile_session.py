"""A session whose manifest was edited: numbers that can be none are refused in a sentence, before any work."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.rig import load_rig
from udccal.sessions.captured import SingleFrame
from udccal.sessions.schema import DarkSubject
from udccal.sessions.writer import SessionWriter


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session with one dark frame, taken at 35 degrees Celsius."""
    settings = Settings(0.02, 0.0, Region(0, 0, 32, 24))
    dark = SingleFrame(Frame(np.full((24, 32), 64, np.uint16), settings, 1.0, 0, True, 35.0))
    with SessionWriter.create(tmp_path / "s", load_rig("lg55-reduced"), CameraIdentity("m", "m", "1", "t")) as writer:
        writer.add_step("noise/dark_0", "noise", DarkSubject(), [dark])
    return tmp_path / "s"


@pytest.mark.parametrize("found", ["NaN", "1e9", "-1e9", "Infinity", '"warm"', "[35.0]"])
def test_a_temperature_that_can_be_none_is_refused(session: Path, found: str) -> None:
    file = session / "session.json"
    content = json.loads(file.read_text())
    del content["manifest_sha256"]
    text = json.dumps(content).replace('"temperature_C": 35.0', f'"temperature_C": {found}')
    assert found in text
    file.write_text(text)
    command = [sys.executable, "-m", "udccal.cli.main", "fit", str(session), "--profile", str(session.parent / "p")]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    said = json.loads(done.stdout)["error"]
    assert said.startswith("Expected a valid 'steps.0.captures.0.temperature_C' in")
    assert not (session.parent / "p").exists()
